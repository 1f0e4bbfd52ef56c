"""Delivery of frames and notices to any number of listeners, none of which can slow or stop the engine."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from typing import Any

__all__ = ["Publisher", "Sink"]

_log = logging.getLogger(__name__)


class Sink:
    """Calls a function with each item, from a thread of its own.

    Args:
        callback: called with one item at a time; what it raises is logged and counted, and the next item is delivered.
        capacity: items that may wait. When full, the oldest is dropped: 1 delivers the newest.
        name: of the thread and in the log.
    """

    def __init__(self, callback: Callable[[Any], None], *, capacity: int = 1, name: str = "sink") -> None:
        self._callback = callback
        self._items: deque[Any] = deque(maxlen=capacity)
        self._changed = threading.Condition()
        self._busy = False
        self._closed = False
        self.dropped = 0
        """Items that were never delivered."""
        self.failures = 0
        """Items that the callback raised at."""
        self._thread = threading.Thread(target=self._run, name=f"aero-viz-{name}", daemon=True)
        self._thread.start()

    def put(self, item: Any) -> None:
        """Hand over an item without waiting; a closed sink takes none."""
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
                _log.exception("%s failed and goes on with the next item", threading.current_thread().name)

    def drain(self, timeout: float = 10.0) -> bool:
        """Wait until everything handed over so far is delivered; False when that takes longer than `timeout` [s]."""
        with self._changed:
            return self._changed.wait_for(lambda: self._closed or not (self._items or self._busy), timeout)

    def close(self, timeout: float | None = 2.0) -> None:
        """Deliver nothing more: what still waits is dropped. An item that is being delivered is waited for up to
        `timeout` [s], with None until it is."""
        with self._changed:
            self._closed = True
            self.dropped += len(self._items)
            self._items.clear()
            self._changed.notify_all()
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout)


class Publisher:
    """Hands each item to any number of sinks."""

    def __init__(self) -> None:
        # Replaced whole, never changed, so that publishing needs no lock.
        self._sinks: tuple[Sink, ...] = ()
        self._lock = threading.Lock()

    def subscribe(self, callback: Callable[[Any], None], *, capacity: int, name: str) -> Sink:
        """Return a new sink for `callback`; see `Sink`."""
        sink = Sink(callback, capacity=capacity, name=name)
        with self._lock:
            self._sinks = (*self._sinks, sink)
        return sink

    def publish(self, item: Any) -> None:
        """Hand `item` to every sink without waiting."""
        for sink in self._sinks:
            sink.put(item)

    def unsubscribe(self, sink: Sink, *, patience: float = 0.0) -> None:
        """Forget a sink and close it, when it has delivered what waits or `patience` [s] is over."""
        with self._lock:
            if sink not in self._sinks:
                return
            self._sinks = tuple(other for other in self._sinks if other is not sink)
        if patience:
            sink.drain(patience)
        sink.close()

    def close(self) -> None:
        """Close all sinks."""
        for sink in self._sinks:
            sink.close()
