"""Delivery of frames and notices to any number of listeners, none of which can slow or stop the engine."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

__all__ = ["Publisher", "Sink"]

T = TypeVar("T")

_log = logging.getLogger(__name__)


class Sink(Generic[T]):
    """Calls a function with each item, on its own thread.

    Args:
        callback: called with one item at a time. An exception is logged and counted; the next item is still delivered.
        capacity: number of items that may wait. When full, the oldest is dropped: 1 delivers the newest.
        name: of the thread, also in the log.
    """

    def __init__(self, callback: Callable[[T], None], *, capacity: int = 1, name: str = "sink") -> None:
        self._callback = callback
        self._items: deque[T] = deque(maxlen=capacity)
        self._changed = threading.Condition()
        self._busy = False
        self._closed = False
        self.dropped = 0
        """Number of items that were never delivered."""
        self.failures = 0
        """Number of items for which the callback raised an exception."""
        self._thread = threading.Thread(target=self._run, name=f"aero-viz-{name}", daemon=True)
        self._thread.start()

    def put(self, item: T) -> None:
        """Hand over an item without waiting. A closed sink ignores it."""
        with self._changed:
            if self._closed:
                return
            self.dropped += len(self._items) == self._items.maxlen
            self._items.append(item)
            self._changed.notify_all()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._busy = False
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._items or self._closed)
                if self._closed:
                    return
                item = self._items.popleft()
                self._busy = True
            try:
                self._callback(item)
            except Exception:
                self.failures += 1
                _log.exception("%s failed; it continues with the next item", threading.current_thread().name)

    def drain(self, timeout: float = 10.0) -> bool:
        """Wait until all items so far are delivered; return False if that takes longer than `timeout` [s]."""
        with self._changed:
            return self._changed.wait_for(lambda: self._closed or not (self._items or self._busy), timeout)

    def close(self, timeout: float | None = 2.0) -> None:
        """Stop delivery and drop the items that wait.

        Waits up to `timeout` [s] for the item that is being delivered, with None as long as it takes.
        """
        with self._changed:
            self._closed = True
            self.dropped += len(self._items)
            self._items.clear()
            self._changed.notify_all()
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout)


class Publisher(Generic[T]):
    """Hands each item to any number of sinks."""

    def __init__(self) -> None:
        # Replaced as a whole and never changed, so that `publish` needs no lock.
        self._sinks: tuple[Sink[T], ...] = ()
        self._lock = threading.Lock()

    def subscribe(self, callback: Callable[[T], None], *, capacity: int, name: str) -> Sink[T]:
        """Return a new sink for `callback`; see `Sink`."""
        sink = Sink(callback, capacity=capacity, name=name)
        with self._lock:
            self._sinks = (*self._sinks, sink)
        return sink

    def publish(self, item: T) -> None:
        """Hand `item` to every sink without waiting."""
        for sink in self._sinks:
            sink.put(item)

    def unsubscribe(self, sink: Sink[T], *, timeout: float = 0.0) -> None:
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
