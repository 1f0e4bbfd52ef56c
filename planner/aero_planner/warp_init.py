"""Start Warp without output: stdout and stderr belong to the program that plans."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Iterator

import warp as wp

__all__ = ["find_device", "init_warp"]

_lock = threading.Lock()
_started = False


def init_warp() -> None:
    """Start Warp, once per process, without its banner and its warning about a missing GPU.

    Module loading is not reported either, unless another log level was chosen. Call this before the first use of Warp,
    which would start it with all of that output.
    """
    global _started
    if wp.config.log_level == wp.LOG_INFO:
        wp.config.log_level = wp.LOG_WARNING
    with _lock:
        if not _started:
            with _silent_stderr():
                wp.init()
            _started = True


def find_device(name: str) -> wp.Device:
    """Return the Warp device "cpu" or such as "cuda:0", after starting Warp.

    Raises:
        ValueError: this machine has no such device; the message lists those that it has.
    """
    init_warp()
    try:
        return wp.get_device(name)
    except Exception as error:
        known = ", ".join(str(device) for device in wp.get_devices())
        raise ValueError(f"device {name!r} is not available: {error}; this machine has {known}.") from error


@contextlib.contextmanager
def _silent_stderr() -> Iterator[None]:
    """Discard what native code writes to stderr."""
    try:
        saved = os.dup(2)
    except OSError:  # stderr is closed, as a service's may be
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
