"""Signals that end a command: SIGTERM, which service managers and `timeout` send, does so as Ctrl-C: results are kept.

Python ignores an exception that is raised while an object is finalized, such as the thousands of arrays of a batch of
flights. A signal that arrives meanwhile is raised again a moment later.
"""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType

_received = threading.Event()
_RETRY_AFTER = 0.01
"""Time after which a signal that would be ignored is sent again [s]."""


def install_handler() -> None:
    """Handle SIGTERM and Ctrl-C from now on. Does nothing outside of the main thread."""
    _received.clear()
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, _interrupt)
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, raise_interrupt)


def is_terminating() -> bool:
    """Return True once SIGTERM was received: the command must not wait for anybody."""
    return _received.is_set()


def raise_interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt, or send the signal again a moment later while an object is finalized.

    This is a handler of signals, and the end of a handler that does not always interrupt.
    """
    if _is_finalizing(frame):
        threading.Timer(_RETRY_AFTER, os.kill, (os.getpid(), number)).start()
        return
    raise KeyboardInterrupt


def _interrupt(number: int, frame: FrameType | None) -> None:
    _received.set()
    handler = signal.getsignal(signal.SIGINT)
    if not callable(handler):  # a background job of a shell ignores Ctrl-C
        handler = raise_interrupt
    handler(number, frame)


def _is_finalizing(frame: FrameType | None) -> bool:
    """Return True if the frame, or one that called it, finalizes an object."""
    while frame is not None:
        if frame.f_code.co_name == "__del__" or frame.f_globals.get("__name__") == "weakref":
            return True
        frame = frame.f_back
    return False
