"""The last sweeps of a LiDAR as one immutable cloud."""

from __future__ import annotations

import functools
import math
import weakref
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

THINNING = 5
"""One point in five of an older sweep is kept."""
FARTHEST_RETURN = 300.0
"""Distance beyond which the LiDAR of a drone sees nothing [m]."""
_SAMPLE = 64
"""Number of points that tell whether a cloud shows something, if one of them is finite."""
HASH_FACTORS = (2654435761, 2246822519, 3266489917)
"""Odd factors of the bits of x, y and z, whose sum chooses the points that are kept: it depends on the point alone."""


def sweeps_within(memory: float, period: float) -> int:
    """Return how many sweeps of a `period` [s] are newer than `memory` [s] when one is complete."""
    return math.ceil(memory / period - 1e-3)


def shows_something(points: NDArray[Any], position: ArrayLike, *, nearest: float = 0.0, empty: bool = False) -> bool:
    """Return True if points [n, 3] show the surroundings of a position [3].

    Points that are not finite or not beyond `nearest` [m] are no returns, or those of the drone itself. At least half
    of the others must be near: no surface that a LiDAR sees is beyond `FARTHEST_RETURN`; a cloud in millimetres is,
    nearly all of it. Without others, the answer is `empty`.
    """
    for some in (points[:: len(points) // _SAMPLE + 1], points):
        offsets = some - np.asarray(position, dtype=np.float64)
        squares = np.einsum("ij,ij->i", offsets, offsets)
        squares = squares[(squares > nearest**2) & (squares < np.inf)]
        if len(squares):
            return bool(2 * np.count_nonzero(squares <= FARTHEST_RETURN**2) >= len(squares))
    return empty


class Arrival(NamedTuple):
    """Time and place at which a sweep was complete."""

    time: float
    """[s], on the clock of the states."""
    position: tuple[float, float, float]
    """Position of the drone [m], world frame."""


class Sweeps:
    """Sweeps in the world frame, oldest first, that `Planner.plan` takes as a cloud.

    A planner copies each sweep to its device once and recognises it in later objects, so that a plan after a new sweep
    copies only that one. Unless something moves or is stray, the plan is that of the joined cloud, bit for bit.

    Args:
        sweeps: points [m], shape [n, 3] each. A read-only float32 array that owns its memory is used as it is, others
            are copied.
        whole: number of newest sweeps of which all points are kept; of older ones one in `THINNING` is, which
            remembers surfaces for longer at little cost. None keeps all points of all sweeps.
        arrivals: when and where each sweep was complete, from which the planner tracks obstacles. None takes a
            sweep for complete when it is first planned from.

    Raises:
        ValueError: a sweep has the wrong shape or type, or there is not one arrival for each.
    """

    def __init__(
        self,
        sweeps: Iterable[NDArray[np.float32]] = (),
        *,
        whole: int | None = None,
        arrivals: Iterable[Arrival | None] | None = None,
    ) -> None:
        self._sweeps = tuple(map(as_constant, sweeps))
        self._whole = whole
        self._arrivals = (None,) * len(self._sweeps) if arrivals is None else tuple(arrivals)
        if len(self._arrivals) != len(self._sweeps):
            raise ValueError(
                f"{len(self._arrivals)} arrivals were given for {len(self._sweeps)} sweeps; give one each."
            )

    def __len__(self) -> int:
        return len(self._sweeps)

    def __iter__(self) -> Iterator[NDArray[np.float32]]:
        return iter(self._sweeps)

    def add(self, sweep: NDArray[np.float32], *, limit: int = 10, arrival: Arrival | None = None) -> Sweeps:
        """Return the newest `limit` sweeps, of which `sweep` is the last."""
        added = Sweeps(whole=self._whole)
        added._sweeps = (*self._sweeps, as_constant(sweep))[-limit:]
        added._arrivals = (*self._arrivals, arrival)[-limit:]
        return added

    @property
    def arrivals(self) -> tuple[Arrival | None, ...]:
        """Time and place at which each sweep was complete; None where that is unknown."""
        return self._arrivals

    @property
    def thinned(self) -> int:
        """Number of oldest sweeps of which only one point in `THINNING` is kept."""
        return 0 if self._whole is None else max(len(self._sweeps) - self._whole, 0)

    @property
    def newest(self) -> NDArray[np.float32]:
        """Points of the newest sweep [m], shape [n, 3]; none if there is no sweep."""
        return self._sweeps[-1] if self._sweeps else np.zeros((0, 3), dtype=np.float32)

    @functools.cached_property
    def points(self) -> NDArray[np.float32]:
        """The joined cloud [m], shape [P, 3], read-only; joined when it is first read."""
        older, newer = self._sweeps[: self.thinned], self._sweeps[self.thinned :]
        kept = [*map(_thin, older), *newer]
        points = np.concatenate(kept) if kept else np.zeros((0, 3), dtype=np.float32)
        points.flags.writeable = False
        return points

    @property
    def point_count(self) -> int:
        """P, the number of points of all sweeps, including those that thinning drops."""
        return sum(map(len, self._sweeps))


_thinned: dict[int, tuple[weakref.ref[NDArray[np.float32]], NDArray[np.float32]]] = {}
"""What is kept of each sweep that still exists, by its identity: a sweep grows old once but is joined many times."""


def _thin(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the points that are kept of an older sweep, as `kernels.shells.thin_sweep` does."""
    key = id(points)
    known = _thinned.get(key)
    if known is not None and known[0]() is points:
        return known[1]
    digest = (points.view(np.uint32) * np.array(HASH_FACTORS, dtype=np.uint32)).sum(axis=1, dtype=np.uint32)
    kept = points[(digest >> 16) % THINNING == 0]
    _thinned[key] = (weakref.ref(points, lambda _: _thinned.pop(key, None)), kept)
    return kept


def is_constant(points: object) -> bool:
    """Return True for a NumPy array that nobody can change: it is read-only and owns its memory."""
    return isinstance(points, np.ndarray) and points.base is None and not points.flags.writeable


def as_constant(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return points [m], shape [n, 3], as a float32 array that nobody can change, a copy unless `points` is one.

    Raises:
        ValueError: the points have the wrong shape or type.
    """
    array = np.asarray(points)
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "fiu":
        raise ValueError(f"a sweep has shape {array.shape} and type {array.dtype}; it must be (n, 3) numbers [m].")
    if array.dtype != np.float32 or not array.flags.c_contiguous or not is_constant(array):
        array = np.array(array, dtype=np.float32, order="C")
        array.flags.writeable = False
    return array
