"""Fit of the sweeps of a recording to each other: matches of points with the surfaces that other sweeps have seen."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_planner.quaternions import rotation_matrix
from aero_viz.recordings.poses import RecordedPoses

if TYPE_CHECKING:
    from aero_viz.recordings.recording import PointSweep, Recording

MAX_RANGE = 25.0
"""Farther points are too sparse to be matched [m]."""
_MIN_RANGE = 0.5
_SURFACE_POINTS = 8
_MAX_THICKNESS = 0.15
"""Largest standard deviation of the neighbours from their plane [m]."""
_MAX_DISTANCE = 1.0
"""Largest distance to the neighbours [m]."""
_NEAR = 0.25
"""A point this near to a surface lies on it [m]."""
_QUERIES = 1500
_CHECKS = 20
_SWEEPS_BEFORE = 5
_MIN_MATCHES = 30


class Matches(NamedTuple):
    """Points of one cloud and the surfaces of another one next to them."""

    query: NDArray[np.intp]
    """Indices of the points [m]."""
    neighbours: NDArray[np.intp]
    """Indices of the points that make up the surfaces [m, 8]."""
    normals: NDArray[np.float64]
    """Normals of the surfaces [m, 3]."""
    distances: NDArray[np.float64]
    """Signed distances from the surfaces [m] [m]."""


def match(surface: NDArray[np.floating], points: NDArray[np.floating]) -> Matches:
    """Return the points [P, 3] [m] that have a flat piece of the cloud `surface` [S, 3] [m] next to them."""
    from scipy.spatial import KDTree

    empty = Matches(np.zeros(0, np.intp), np.zeros((0, _SURFACE_POINTS), np.intp), np.zeros((0, 3)), np.zeros(0))
    if len(surface) < _SURFACE_POINTS or not len(points):
        return empty
    tree = KDTree(surface, balanced_tree=False)  # a balanced one takes longer to build than it saves
    far, index = tree.query(points, k=_SURFACE_POINTS, distance_upper_bound=_MAX_DISTANCE)
    query = np.flatnonzero(np.isfinite(far).all(axis=1))
    if not len(query):
        return empty
    index = np.asarray(index)[query]
    patch = surface[index].astype(np.float64)
    centre = patch.mean(axis=1)
    spread = np.einsum("nki,nkj->nij", patch - centre[:, None], patch - centre[:, None]) / _SURFACE_POINTS
    values, vectors = np.linalg.eigh(spread)
    normals = vectors[:, :, 0]
    flat = (values[:, 0] < _MAX_THICKNESS**2) & (values[:, 0] < 0.1 * values[:, 1])
    distances = np.einsum("ni,ni->n", points[query] - centre, normals)
    return Matches(query[flat], index[flat], normals[flat], distances[flat])


def thin(sweep: PointSweep, count: int) -> PointSweep:
    """Return about `count` points of a sweep, evenly chosen among those within 25 m."""
    distance = np.linalg.norm(sweep.points, axis=1)
    kept = np.flatnonzero((distance > _MIN_RANGE) & (distance < MAX_RANGE))
    kept = kept[:: max(1, len(kept) // count)]
    times = None if sweep.point_times is None else sweep.point_times[kept]
    return sweep._replace(points=sweep.points[kept], point_times=times)


def place(sweep: PointSweep, poses: RecordedPoses, *, shift: float = 0.0) -> NDArray[np.float64]:
    """Return the points of a sweep in the world frame [P, 3] [m], each moved by the pose at its own time.

    Args:
        sweep: points in the body frame.
        poses: motion of the body.
        shift: time to add to that of the sweep [s].
    """
    if not len(sweep.points):
        return np.zeros((0, 3))
    track = poses.track
    if sweep.point_times is None:
        position, quaternion = track.interpolate(sweep.time + shift)
        return sweep.points @ rotation_matrix(quaternion).T + position
    times = np.clip(sweep.time + shift + sweep.point_times.astype(np.float64), track.times[0], track.times[-1])
    return track.deskew(sweep.points, times)[0].astype(np.float64)


def fit_of_sweeps(recording: Recording, poses: RecordedPoses) -> list[tuple[float, float]]:
    """Return times [s] and the shares of the points then that lie on surfaces of the five sweeps before."""
    count = len(recording.sweep_times)
    found = []
    first = min(_SWEEPS_BEFORE, max(count - 1, 1))
    for index in np.unique(np.linspace(first, count - 1, _CHECKS).astype(int)) if count > first else ():
        before = range(max(0, index - _SWEEPS_BEFORE), index)
        surface = np.concatenate([place(thin(recording.sweep(i), 10_000), poses) for i in before])
        matches = match(surface, place(thin(recording.sweep(int(index)), _QUERIES), poses))
        if len(matches.query) >= _MIN_MATCHES:
            share = float((np.abs(matches.distances) < _NEAR).mean())
            found.append((float(recording.sweep_times[index]), share))
    return found
