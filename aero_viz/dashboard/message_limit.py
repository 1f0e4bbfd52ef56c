"""Rate limit for the messages of a client, so that a flood delays nothing else."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Hashable
from concurrent.futures import Future
from typing import Any, Generic, TypeVar

T = TypeVar("T")

_MESSAGES_MAX = 60
"""Messages of a control that are handled per period; a page sends at most 50 per second."""
_PERIOD = 1.0
"""Shortest period [s]; it lasts until the session has caught up."""
_CONTROLS_MAX = 1000
"""Largest number of controls that are counted; the page has about 300."""
_POLL_PERIOD = 0.1
"""Time between two checks of a session that has not caught up [s]."""


class MessageLimit(Generic[T]):
    """Limits the rate at which the messages of one client are handled, separately for each control.

    In each period, 60 messages of a control are handled. A period ends when a second has passed and the session has
    caught up. Further clicks are dropped. Of further values, the newest one waits for the next period, in which it is
    handled before any other message.

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
        """Time after which `due` may return waiting messages [s]; None if none wait."""
        if not self._waiting:
            return None
        return max(self._began + _PERIOD - time.monotonic(), _POLL_PERIOD)

    def admit(self, control: Hashable, message: T, *, is_click: bool) -> list[T]:
        """Return the messages to handle after `message` has arrived, in order."""
        due = self.due()
        is_known = control in self._counts or len(self._counts) < _CONTROLS_MAX
        if is_known and self._counts[control] < _MESSAGES_MAX:
            self._counts[control] += 1
            return [*due, *self._take_waiting(), message]
        if is_known and not is_click:
            self._waiting[control] = message
        return due

    def due(self) -> list[T]:
        """Return the waiting values if the period has ended."""
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
