"""MAVLink messages that an autopilot repeats at a rate that the companion may set."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass
class PeriodicMessage:
    """A message that is sent at the first step after each multiple of its period."""

    make: Callable[[], list[Any]]
    """Returns the message, or the messages that together replace it."""
    period: float = math.inf
    """Time between two messages [s]; infinite if the message is only sent on request."""

    def __post_init__(self) -> None:
        self._next = 0.0 if math.isfinite(self.period) else math.inf

    def request(self, period: float, now: float) -> None:
        """Send it with another period [s] from the time `now` [s] on, as SET_MESSAGE_INTERVAL asks."""
        if math.isinf(self.period):
            self._next = now
        self.period = period

    def take_due(self, now: float) -> list[Any]:
        """Return the messages that are due at the time `now` [s]."""
        if now < self._next:
            return []
        self._next = max(self._next + self.period, now)
        return self.make()
