"""SIGTERM, which service managers and `timeout` send. It ends a command as Ctrl-C does, so that results are kept."""

from __future__ import annotations

import signal
import threading
from types import FrameType

_received = threading.Event()


def install_handler() -> None:
    """Handle SIGTERM from now on. Does nothing outside of the main thread."""
    _received.clear()
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, _interrupt)


def is_terminating() -> bool:
    """Return True once SIGTERM was received: the command must not wait for anybody."""
    return _received.is_set()


def _interrupt(number: int, frame: FrameType | None) -> None:
    _received.set()
    handler = signal.getsignal(signal.SIGINT)
    if not callable(handler):  # a background job of a shell ignores Ctrl-C
        raise KeyboardInterrupt
    handler(signal.SIGINT, frame)
