"""Hands items, such as frames, to any number of listeners."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from aero_planner.mailbox import Mailbox

T = TypeVar("T")


class Publisher(Generic[T]):
    """Hands each item to any number of mailboxes, its sinks."""

    def __init__(self) -> None:
        # Replaced as a whole and never changed, so that `publish` needs no lock.
        self._sinks: tuple[Mailbox[T], ...] = ()
        self._lock = threading.Lock()

    def subscribe(self, callback: Callable[[T], None], *, capacity: int, name: str) -> Mailbox[T]:
        """Return a new sink that calls `callback` with each item; see `Mailbox`."""
        sink = Mailbox(callback, capacity=capacity, name=f"aero-viz-{name}")
        with self._lock:
            self._sinks = (*self._sinks, sink)
        return sink

    def publish(self, item: T) -> None:
        """Hand `item` to every sink without waiting."""
        for sink in self._sinks:
            sink.put(item)

    def unsubscribe(self, sink: Mailbox[T], *, timeout: float = 0.0) -> None:
        """Remove and close a sink. Items that still wait are delivered for up to `timeout` [s]."""
        with self._lock:
            if sink not in self._sinks:
                return
            self._sinks = tuple(kept for kept in self._sinks if kept is not sink)
        if timeout:
            sink.drain(timeout)
        sink.close()

    def close(self) -> None:
        """Close all sinks."""
        for sink in self._sinks:
            sink.close()
