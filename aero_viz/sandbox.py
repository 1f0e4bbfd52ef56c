"""What a process that reads files may still touch: Linux takes the rest from it, where it has Landlock."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterable

_SYSTEM = ("/bin", "/etc", "/lib", "/lib64", "/proc", "/sbin", "/sys", "/usr")
"""Folders of the system, in which Python and its libraries read."""
_DEVICES = ("/dev/null", "/dev/random", "/dev/urandom", "/dev/zero")


def confine(readable: Iterable[str] | None, writable: Iterable[str] = ()) -> bool:
    """Confine this process and those that it starts, for good: each call takes away more.

    They can then reach no TCP port, send no signals to other processes, and write only in the temporary folder.

    Args:
        readable: folders in which they may read, besides those of Python and of the system; None is all.
        writable: further folders in which they may read and write.

    Returns:
        True if the kernel confines them; False on other systems, and where Linux is older than 5.13 or does without.
    """
    if sys.platform != "linux":
        return False
    from landlockpy import AccessFS, Ruleset, Scope, UnsupportedError

    read = AccessFS.READ_FILE | AccessFS.READ_DIR | AccessFS.EXECUTE
    everything = ~AccessFS.NONE
    python = {sys.prefix, sys.base_prefix, os.path.dirname(os.path.realpath(sys.executable)), *filter(None, sys.path)}
    places = ["/"] if readable is None else [*_SYSTEM, *python, *readable]
    try:
        with Ruleset(scoped=Scope.SIGNAL | Scope.ABSTRACT_UNIX_SOCKET) as ruleset:
            for place in filter(os.path.isdir, places):
                ruleset.allow_path(place, read)
            for place in filter(os.path.exists, _DEVICES):
                ruleset.allow_path(place, AccessFS.READ_FILE | AccessFS.WRITE_FILE)
            for place in filter(os.path.isdir, (tempfile.gettempdir(), *writable)):
                ruleset.allow_path(place, everything)
            ruleset.restrict()
    except UnsupportedError:
        return False
    return True
