"""The sweeps of a flight: the inputs of their measurement, and the points of the newest ones."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_viz.flight.memory import SWEEPS
from aero_viz.flight.simulator import Setting

Cloud = NDArray[np.float32]
Pose = NDArray[np.float32]

CACHED_BYTES = 32_000_000
"""Size of the sweeps that are cached, the newest ones. Older sweeps are measured again when a checkpoint needs them."""


@dataclass(frozen=True, eq=False, slots=True)
class Scan:
    """Inputs of the measurement of points first .. end - 1 of a sweep; with the seed, they reproduce it bit for bit."""

    sweep: int
    first: int
    end: int
    before: Pose
    """True and estimated pose at the beginning: position [m] and quaternion w, x, y, z, float32 [2, 7]."""
    after: Pose
    """True and estimated pose at the end."""
    setting: Setting
    """World and LiDAR of the measurement."""


@dataclass(eq=False, slots=True)
class Sweep:
    """A complete sweep."""

    scans: tuple[Scan, ...]
    points: Cloud | None
    """Returns [m], [P, 3], world frame; None if they are not cached."""


class SweepCache:
    """Keeps the points of the newest sweeps, `CACHED_BYTES` in all, and measures those of older ones again.

    Args:
        measure: measures the points of a scan, including rays without return.
    """

    def __init__(self, measure: Callable[[Scan], Cloud]) -> None:
        self._measure = measure
        self._sweeps: deque[Sweep] = deque()
        self._bytes = 0
        self._fewest = SWEEPS
        """Number of sweeps that stay cached whatever their size."""
        self._adopted: dict[int, tuple[Sweep, Sweep]] = {}
        """Sweeps of another source by their id, each with its copy."""

    def points(self, sweeps: tuple[Sweep, ...]) -> list[Cloud]:
        """Return the points of each sweep, and cache them."""
        self._fewest = max(SWEEPS, len(sweeps))
        return [self._points(sweep) for sweep in sweeps]

    def _points(self, sweep: Sweep) -> Cloud:
        if sweep.points is None:
            sweep.points = join_returns([self._measure(scan) for scan in sweep.scans])
            self.add(sweep)
        return sweep.points

    def add(self, sweep: Sweep) -> None:
        """Cache the points of a sweep, and drop the points that were cached first."""
        assert sweep.points is not None
        self._sweeps.append(sweep)
        self._bytes += sweep.points.nbytes
        while self._bytes > CACHED_BYTES and len(self._sweeps) > self._fewest:
            oldest = self._sweeps.popleft()
            assert oldest.points is not None
            self._bytes -= oldest.points.nbytes
            oldest.points = None

    def adopt(self, sweeps: tuple[Sweep, ...]) -> tuple[Sweep, ...]:
        """Return copies of another source's sweeps, to leave its cache alone; the same sweep has the same copy."""
        known, self._adopted = self._adopted, {}
        for sweep in sweeps:
            if id(sweep) not in known:
                copy = Sweep(sweep.scans, sweep.points)
                known[id(sweep)] = (sweep, copy)
                if copy.points is not None:
                    self.add(copy)
            self._adopted[id(sweep)] = known[id(sweep)]
        return tuple(self._adopted[id(sweep)][1] for sweep in sweeps)


def join_returns(parts: list[Cloud]) -> Cloud:
    """Return the parts of a sweep in one array, without the rays that have no return."""
    points: Any = np.concatenate(parts)
    returns: Any = np.compress(~np.isnan(points[:, 0]), points, axis=0)
    returns.flags.writeable = False
    return returns
