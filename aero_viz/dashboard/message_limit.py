"""How many messages of a client are handled, so that a flood delays nothing else."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Hashable
from concurrent.futures import Future
from typing import Any, Generic, TypeVar

T = TypeVar("T")

_MESSAGES_MAX = 60
"""Messages of a control that are handled in a row; a page sends at most 50 a second."""
_PERIOD = 1.0
"""Shortest time until as many are handled again [s]."""
_CONTROLS_MAX = 1000
"""Controls that are counted; the page has some 300."""
_POLL_PERIOD = 0.1
"""Time between two looks at a session that has not answered [s]."""


class MessageLimit(Generic[T]):
    """Thins out the messages of one client, each control by itself.

    So many of a control are handled until a second has passed and the session has caught up. Of more clicks the rest is
    dropped. Of more values the newest one waits, and is handled before any other message.

    Args:
        catch_up: returns a future that is done when the session has run every command that it was given before.
    """

    def __init__(self, catch_up: Callable[[], Future[Any]]) -> None:
        self._catch_up = catch_up
        self._caught_up: Future[Any] | None = None
        self._counts: Counter[Hashable] = Counter()
        self._waiting: dict[Hashable, T] = {}
        self._began = time.monotonic()

    @property
    def delay(self) -> float | None:
        """Time after which to ask for the messages that wait [s]; None if there are none."""
        if not self._waiting:
            return None
        return max(self._began + _PERIOD - time.monotonic(), _POLL_PERIOD)

    def admit(self, control: Hashable, message: T, *, is_click: bool) -> list[T]:
        """Return what is handled now that `message` has arrived, in this order."""
        due = self.due()
        is_known = control in self._counts or len(self._counts) < _CONTROLS_MAX
        if is_known and self._counts[control] < _MESSAGES_MAX:
            self._counts[control] += 1
            return [*due, *self._take_waiting(), message]
        if is_known and not is_click:
            self._waiting[control] = message
        return due

    def due(self) -> list[T]:
        """Return the values that have waited long enough."""
        if time.monotonic() < self._began + _PERIOD:
            return []
        if self._caught_up is None:
            self._caught_up = self._catch_up()
        if not self._caught_up.done():
            return []
        self._caught_up, self._began = None, time.monotonic()
        self._counts.clear()
        return self._take_waiting()

    def _take_waiting(self) -> list[T]:
        messages, self._waiting = list(self._waiting.values()), {}
        return messages
