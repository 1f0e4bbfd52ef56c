"""Which moment of a source the wall clock has reached."""

from __future__ import annotations

import time

__all__ = ["Clock"]


class Clock:
    """Maps source time to wall time at a speed that may change.

    Args:
        speed: source time per wall time.
    """

    def __init__(self, speed: float = 1.0) -> None:
        self._speed = speed
        self.restart(0.0)

    @property
    def speed(self) -> float:
        """Source time per wall time."""
        return self._speed

    @speed.setter
    def speed(self, speed: float) -> None:
        now = self.now()
        self._speed = speed
        self.restart(now)

    def restart(self, source_time: float) -> None:
        """Let the present moment be `source_time` [s]."""
        self._source_start = source_time
        self._wall_start = time.monotonic()

    def now(self) -> float:
        """Return the source time that the wall clock has reached [s]."""
        return self._source_start + (time.monotonic() - self._wall_start) * self._speed

    def delay_until(self, source_time: float) -> float:
        """Return the wall time left until `source_time` [s], 0 when it is past."""
        return max(0.0, (source_time - self.now()) / self._speed)
