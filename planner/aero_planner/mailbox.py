"""A bounded mailbox that keeps the newest items and delivers them on its own thread."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

_log = logging.getLogger(__name__)

T = TypeVar("T")

_NICENESS = 10


def lower_thread_priority() -> None:
    """Let the calling thread run only when more urgent threads are idle, where the system supports it (Linux)."""
    with contextlib.suppress(AttributeError, OSError):
        thread = threading.get_native_id()
        nice = os.getpriority(os.PRIO_PROCESS, thread)
        os.setpriority(os.PRIO_PROCESS, thread, min(nice + _NICENESS, 19))


class Mailbox(Generic[T]):
    """Calls a function with each item, on a thread that the sender never waits for.

    When the mailbox is full, the oldest item is dropped: a capacity of 1 delivers the newest.

    Args:
        callback: Called with one item at a time. The first exception is logged, all are counted, and the next item is
            still delivered.
        capacity: Largest number of items that wait.
        name: Name of the thread, which also appears in the log.
        low_priority: Run the callback at a lower priority than the process's other threads.
        at_end: Called on the thread after the last item.

    Attributes:
        dropped: Number of items that were never delivered.
        failures: Number of items for which the callback raised an exception.
    """

    def __init__(
        self,
        callback: Callable[[T], None],
        *,
        capacity: int = 1,
        name: str,
        low_priority: bool = False,
        at_end: Callable[[], None] | None = None,
    ) -> None:
        self.dropped = 0
        self.failures = 0
        self._callback = callback
        self._low_priority = low_priority
        self._at_end = at_end
        self._items: deque[T] = deque()
        self._capacity = capacity
        self._changed = threading.Condition()
        self._busy = False
        self._closed = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, item: T) -> bool:
        """Hand over an item without waiting; return False if the mailbox is closed and does not take it."""
        with self._changed:
            if self._closed:
                return False
            if len(self._items) == self._capacity:
                self._items.popleft()
                self.dropped += 1
            self._items.append(item)
            self._changed.notify_all()
            return True

    def drain(self, timeout: float = 10.0) -> bool:
        """Wait up to `timeout` [s] until every item is delivered; return False if that takes longer."""
        with self._changed:
            return self._changed.wait_for(lambda: self._closed or not (self._items or self._busy), timeout)

    def finish(self, timeout: float = 5.0) -> bool:
        """Deliver the waiting items for up to `timeout` [s], then close; return True if the thread has ended."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._join(timeout)
        return self.close(0.0)

    def close(self, timeout: float | None = 2.0) -> bool:
        """Drop the waiting items and end the thread.

        Args:
            timeout: Longest time to wait for an item that is being delivered [s]; None waits until it is.

        Returns:
            True if the thread has ended.
        """
        with self._changed:
            self._closed = True
            self.dropped += len(self._items)
            self._items.clear()
            self._changed.notify_all()
        self._join(timeout)
        return not self._thread.is_alive()

    def _join(self, timeout: float | None) -> None:
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout)

    def _run(self) -> None:
        if self._low_priority:
            lower_thread_priority()
        while (item := self._next()) is not None:
            try:
                self._callback(item[0])
            except Exception:
                self.failures += 1
                if self.failures == 1:
                    _log.exception("%s failed; it continues, and further failures are only counted", self._thread.name)
        if self._at_end is not None:
            self._at_end()

    def _next(self) -> tuple[T] | None:
        """Wait for the next item; return None when the mailbox is closed and empty."""
        with self._changed:
            self._busy = False
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._items or self._closed)
            if not self._items:
                return None
            self._busy = True
            return (self._items.popleft(),)
