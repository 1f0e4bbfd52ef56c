"""Warp without words: stdout and stderr belong to the program that plans."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Iterator

import warp as wp

__all__ = ["quieten"]

_lock = threading.Lock()
_started = False


def quieten() -> None:
    """Start Warp, if that has not been done, without its banner and its complaint about a missing GPU; of the modules
    that it loads it does not report either, unless another level of its log was chosen.

    Call it before the first use of Warp, which would start it with all of these.
    """
    global _started
    if wp.config.log_level == wp.LOG_INFO:
        wp.config.log_level = wp.LOG_WARNING
    with _lock:
        if not _started:
            with _no_stderr():
                wp.init()
            _started = True


@contextlib.contextmanager
def _no_stderr() -> Iterator[None]:
    """Keep what native code writes to stderr off the terminal."""
    try:
        saved = os.dup(2)
    except OSError:  # it is closed, as a service's may be
        yield
        return
    if sys.stderr is not None:
        sys.stderr.flush()
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)
    try:
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(null)
