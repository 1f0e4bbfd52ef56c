"""Deferred Ctrl-C: a loop checks for it between two ticks, so that ticks and files are complete."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType

from aero_viz.flight.metrics import FlightResult


class FlightInterrupted(KeyboardInterrupt):
    """Ctrl-C was pressed during a flight.

    Attributes:
        result: metrics of the flight so far; its reason is None.
    """

    def __init__(self, result: FlightResult) -> None:
        super().__init__()
        self.result = result


@contextlib.contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Give the context a function that returns True once Ctrl-C was pressed; a second Ctrl-C interrupts immediately.

    Only the main thread receives signals; in other threads the function always returns False.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    pressed = False

    def handle(number: int, frame: FrameType | None) -> None:
        nonlocal pressed
        if pressed:
            raise KeyboardInterrupt
        pressed = True

    previous = signal.signal(signal.SIGINT, handle)
    try:
        yield lambda: pressed
    finally:
        signal.signal(signal.SIGINT, previous)
