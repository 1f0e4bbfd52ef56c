"""Conversion of another device's time stamps to host time."""

from __future__ import annotations

import math


class HostClock:
    """Maps time stamps of a device to host time, from the stamps and their arrival times alone.

    A message arrives some time after its stamp, and this delay is never negative. The offset between the clocks is
    therefore the minimum of arrival - stamp, taken over the last 5 to 10 s so that it follows a drift. No stamp is
    mapped later than its arrival.

    A stamp that goes back, or runs ahead, by more than `jump` is rejected. After 20 such stamps in a row, the device's
    clock is considered to have been set, and the offset is estimated anew. A stamp that is merely late is accepted.

    Args:
        jump: Largest inconsistency that is accepted [s].
        window: Half of the longest time over which the minimum is taken [s].

    Attributes:
        rejected: Number of rejected stamps.
    """

    PATIENCE = 20
    """Number of inconsistent stamps in a row after which they are accepted."""

    def __init__(self, *, jump: float = 1.0, window: float = 5.0) -> None:
        self.rejected = 0
        self._jump, self._window = jump, window
        self._restart(math.nan, -math.inf, 0.0)
        self._misfits = 0

    def to_host(self, stamp: float, arrival: float, *, max_offset: float = math.inf) -> float | None:
        """Return the host time of a stamp [s]; None if the stamp is rejected.

        Args:
            stamp: Time by the device's clock [s].
            arrival: When the message was received, host time [s].
            max_offset: Largest offset between the clocks, where it is known otherwise [s].
        """
        if not (math.isfinite(stamp) and math.isfinite(arrival)):
            self.rejected += 1
            return None
        delta = arrival - stamp
        if math.isnan(self._current):
            self._restart(delta, stamp, arrival)
        elif stamp < self._newest - self._jump or delta < min(self._current, self._previous) - self._jump:
            self._misfits += 1
            if self._misfits < self.PATIENCE:
                self.rejected += 1
                return None
            self._restart(delta, stamp, arrival)
        self._misfits = 0
        self._newest = max(self._newest, stamp)
        if arrival - self._began > 2.0 * self._window:
            self._restart(delta, stamp, arrival)  # after such a pause the old minimum is of little use
        elif arrival - self._began > self._window:
            self._previous, self._current, self._began = self._current, delta, arrival
        self._current = min(self._current, delta)
        return stamp + min(self._current, self._previous, max_offset)

    def _restart(self, delta: float, stamp: float, arrival: float) -> None:
        self._current, self._previous = delta, math.inf
        self._newest, self._began = stamp, arrival
