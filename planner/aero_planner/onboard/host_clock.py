"""Another device's clock in host time, from nothing but its stamps and when they arrive."""

from __future__ import annotations

import math

__all__ = ["HostClock"]


class HostClock:
    """Maps stamps of a device to host time.

    A message arrives some delay after its stamp, and the delay is never negative: the offset between the clocks is the
    minimum of arrival - stamp, taken over the last 5 to 10 s so that it follows a drift. No stamp is mapped later than
    its arrival. A stamp that goes back, or runs ahead, by more than `jump` does not fit; when 20 in a row do not, the
    device's clock was set anew, and so is the offset. A stamp that is merely late fits: it is late.

    Args:
        jump: [s].
        window: half of the longest time over which the minimum is taken [s].

    Attributes:
        rejected: number of stamps that did not fit.
    """

    PATIENCE = 20
    """Stamps in a row that have to misfit before they are believed."""

    def __init__(self, *, jump: float = 1.0, window: float = 5.0) -> None:
        self.rejected = 0
        self._jump, self._window = jump, window
        self._restart(math.nan, -math.inf, 0.0)
        self._misfits = 0

    def to_host(self, stamp: float, arrival: float) -> float | None:
        """Return the host time of a stamp [s]; None when it does not fit.

        Args:
            stamp: by the device's clock [s].
            arrival: when the message was received, host time [s].
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
            self._restart(delta, stamp, arrival)  # nothing came for so long that the old minimum says little
        elif arrival - self._began > self._window:
            self._previous, self._current, self._began = self._current, delta, arrival
        self._current = min(self._current, delta)
        return stamp + min(self._current, self._previous)

    def _restart(self, delta: float, stamp: float, arrival: float) -> None:
        self._current, self._previous = delta, math.inf
        self._newest, self._began = stamp, arrival
