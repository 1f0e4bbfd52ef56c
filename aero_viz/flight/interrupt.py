"""Deferred Ctrl-C: a loop checks for it between two ticks, so that ticks and files are complete."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType

from aero_planner.termination import raise_interrupt
from aero_viz.flight.metrics import FlightResult


class FlightInterrupted(KeyboardInterrupt):
    """Ctrl-C was pressed during a flight.

    Attributes:
        result: metrics of the flight so far; its reason is None unless Ctrl-C was pressed during the last tick.
    """

    def __init__(self, result: FlightResult) -> None:
        super().__init__()
        self.result = result


@contextlib.contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Give the context a function that returns True once Ctrl-C was pressed; a second Ctrl-C interrupts immediately.

    A Ctrl-C that the function did not report takes effect at the end of the context, so that it is not lost. Only the
    main thread receives signals; in other threads the function always returns False.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    pressed = reported = False

    def handle(number: int, frame: FrameType | None) -> None:
        nonlocal pressed
        if pressed:
            raise_interrupt(number, frame)
        pressed = True

    def is_interrupted() -> bool:
        nonlocal reported
        reported = pressed
        return pressed

    previous = signal.signal(signal.SIGINT, handle)
    try:
        yield is_interrupted
    finally:
        signal.signal(signal.SIGINT, previous)
    if pressed and not reported:
        signal.raise_signal(signal.SIGINT)
