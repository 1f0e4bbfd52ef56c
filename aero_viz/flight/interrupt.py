"""Ctrl-C as a question that a loop asks between two ticks, so that it leaves whole ticks and whole files behind."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType

from aero_viz.flight.metrics import FlightResult

__all__ = ["FlightInterrupted", "deferred_interrupt"]


class FlightInterrupted(KeyboardInterrupt):
    """Ctrl-C during a flight.

    Attributes:
        result: what was flown so far; its reason is None.
    """

    def __init__(self, result: FlightResult) -> None:
        super().__init__()
        self.result = result


@contextlib.contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Let the context ask whether Ctrl-C was pressed; the second one interrupts at once, as ever.

    Outside of the main thread, which alone gets signals, the answer is always no.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    pressed = False

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal pressed
        if pressed:
            raise KeyboardInterrupt
        pressed = True

    before = signal.signal(signal.SIGINT, note)
    try:
        yield lambda: pressed
    finally:
        signal.signal(signal.SIGINT, before)
