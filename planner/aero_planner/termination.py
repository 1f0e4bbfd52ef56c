"""Signals that end a command as Ctrl-C does, so that results are kept.

They are SIGTERM, which service managers and `timeout` send, and SIGHUP, which a lost terminal sends.

Python ignores an exception that is raised while an object is finalized, such as the thousands of arrays of a batch of
flights, or in a callback of a weak reference. Before version 3.12, it replaces one that is raised in `__set_name__`, as
while a module with dataclasses is imported, by a RuntimeError. An exception while a temporary folder or file is made or
removed would leave it behind. A signal that arrives meanwhile is sent again a moment later.

Python also remembers a KeyboardInterrupt that ends a text given to `exec`, as while a dataclass is made, and in the end
kills the process by SIGINT although the exception was handled. Executing another text makes it forget.
"""

from __future__ import annotations

import atexit
import os
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any

_received = threading.Event()
_RETRY_AFTER = 0.01
"""Time after which a signal that would be ignored, or would leave files behind, is sent again [s]."""
_UNINTERRUPTED = ("weakref", "_weakrefset", "tempfile", "aero_planner.output_files")
"""Modules whose functions are not interrupted: they run while an object is finalized, or make and remove files."""
_UNINTERRUPTED_METHODS = ("__del__", "__set_name__")
_terminals: list[int] = []
"""Numbers of the output streams that go to a terminal."""


def install_handler() -> None:
    """Handle SIGTERM, SIGHUP and Ctrl-C from now on. Does nothing outside of the main thread."""
    _received.clear()
    atexit.unregister(_forget_handled_interrupt)
    atexit.register(_forget_handled_interrupt)
    if threading.current_thread() is threading.main_thread():
        _terminals[:] = filter(os.isatty, (1, 2))
        signal.signal(signal.SIGTERM, _interrupt)
        if signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:  # nohup ignores it
            signal.signal(signal.SIGHUP, _interrupt)
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, raise_interrupt)
        if not isinstance(sys.unraisablehook, _UnraisableHook):
            sys.unraisablehook = _UnraisableHook(sys.unraisablehook)


def is_terminating() -> bool:
    """Return True once SIGTERM or SIGHUP was received: the command must not wait for anybody."""
    return _received.is_set()


def raise_interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt, or send the signal again a moment later while nothing may be interrupted.

    This is a handler of signals, and the end of a handler that does not always interrupt.
    """
    if _is_uninterrupted(frame):
        _send_again(number)
        return
    raise KeyboardInterrupt


def leave_terminal() -> None:
    """Discard what is written to the terminal from now on, and ignore SIGHUP: the terminal was lost.

    Writing to it would fail. The system and the shell may both report the loss.
    """
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    for stream in _terminals:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream)


def _forget_handled_interrupt() -> None:
    exec("")


def _interrupt(number: int, frame: FrameType | None) -> None:
    _received.set()
    if number == signal.SIGHUP:
        leave_terminal()
        number = signal.SIGTERM  # if it has to be sent again
    handler = signal.getsignal(signal.SIGINT)
    if not callable(handler):  # a background job of a shell ignores Ctrl-C
        handler = raise_interrupt
    handler(number, frame)


def _is_uninterrupted(frame: FrameType | None) -> bool:
    """Return True if the frame, or one that called it, must not raise KeyboardInterrupt."""
    while frame is not None:
        if frame.f_code.co_name in _UNINTERRUPTED_METHODS or frame.f_globals.get("__name__") in _UNINTERRUPTED:
            return True
        frame = frame.f_back
    return False


class _UnraisableHook:
    """Sends a signal again whose KeyboardInterrupt Python ignores, as in a generator that is discarded.

    Args:
        report: the hook before, which reports all other exceptions.
    """

    def __init__(self, report: Callable[[Any], Any]) -> None:
        self._report = report

    def __call__(self, ignored: Any) -> None:
        if isinstance(ignored.exc_value, KeyboardInterrupt):
            _send_again(signal.SIGTERM if is_terminating() else signal.SIGINT)
        else:
            self._report(ignored)


def _send_again(number: int) -> None:
    if threading.main_thread().is_alive():  # otherwise the program is ending already
        threading.Timer(_RETRY_AFTER, os.kill, (os.getpid(), number)).start()
