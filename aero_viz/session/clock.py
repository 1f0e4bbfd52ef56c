"""Clock that maps wall time to source time."""

from __future__ import annotations

import time


class Clock:
    """Maps wall time to source time at a variable speed.

    Args:
        speed: source time that passes per wall time.
    """

    def __init__(self, speed: float = 1.0) -> None:
        self._speed = speed
        self.restart(0.0)

    @property
    def speed(self) -> float:
        """Source time that passes per wall time."""
        return self._speed

    @speed.setter
    def speed(self, speed: float) -> None:
        now = self.now()
        self._speed = speed
        self.restart(now)

    def restart(self, source_time: float) -> None:
        """Set the current source time [s]."""
        self._source_start = source_time
        self._wall_start = time.monotonic()

    def now(self) -> float:
        """Return the current source time [s]."""
        return self._source_start + (time.monotonic() - self._wall_start) * self._speed

    def delay_until(self, source_time: float) -> float:
        """Return the wall time left until `source_time` [s], 0 if it has passed."""
        return max(0.0, (source_time - self.now()) / self._speed)
