"""A thread of its own for whoever looks at what the node does, so that nobody who looks can delay it."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

__all__ = ["Mailbox", "lower_thread_priority"]

_log = logging.getLogger(__name__)

T = TypeVar("T")

_NICENESS = 10


def lower_thread_priority() -> None:
    """Let the calling thread run when the node's others need no processor, where the system has it (Linux)."""
    with contextlib.suppress(AttributeError, OSError):
        thread = threading.get_native_id()
        nice = os.getpriority(os.PRIO_PROCESS, thread)
        os.setpriority(os.PRIO_PROCESS, thread, min(nice + _NICENESS, 19))


class Mailbox(Generic[T]):
    """Calls a function with each item, from a thread of its own.

    Args:
        callback: called with one item at a time; what it raises is logged and counted.
        capacity: items that may wait; when full the oldest goes.
        name: of the thread.
        at_end: called from the thread after the last item.

    Attributes:
        dropped: items that went because the box was full or closed.
        failures: items at which the callback raised.
    """

    def __init__(
        self, callback: Callable[[T], None], *, capacity: int, name: str, at_end: Callable[[], None] = lambda: None
    ) -> None:
        self.dropped = 0
        self.failures = 0
        self._callback = callback
        self._at_end = at_end
        self._items: deque[T] = deque()
        self._capacity = capacity
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, item: T) -> None:
        """Hand over an item without waiting for anyone who works on one."""
        with self._changed:
            if self._closed:
                self.dropped += 1
                return
            if len(self._items) == self._capacity:
                self._items.popleft()
                self.dropped += 1
            self._items.append(item)
            self._changed.notify()

    def _run(self) -> None:
        lower_thread_priority()
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._items or self._closed)
                if not self._items:
                    break
                item = self._items.popleft()
            try:
                self._callback(item)
            except Exception:
                self.failures += 1
                if self.failures == 1:
                    _log.exception("%s failed; it goes on, and further failures are only counted", self._thread.name)
        self._at_end()

    def close(self, timeout: float = 5.0) -> bool:
        """Deliver what waits, for `timeout` [s] at most, and end the thread; return whether it has ended.

        What waits still when the time is over is dropped.
        """
        with self._changed:
            self._closed = True
            self._changed.notify()
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout)
        with self._changed:
            self.dropped += len(self._items)
            self._items.clear()
        return not self._thread.is_alive()
