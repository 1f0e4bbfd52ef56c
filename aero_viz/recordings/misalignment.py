"""The time offset between sweeps and poses and the error of the sensor's mounting, from how well sweeps fit together.

Sweeps are moved to the world by poses that are shifted in time by tau and with points that are rotated by a small
rotation delta. Gauss-Newton finds the tau and delta with which the points of one sweep lie nearest to the surfaces of
another one: point-to-plane distances, Huber weights. The search starts from the best of several tau, because with an
offset of tens of milliseconds most of the matched neighbours are wrong. Each of two sweeps is compared with the other:
the surfaces of a sparse sweep are biased towards the side from which it was taken. Only a motion with turns or changes
of speed shows a misalignment; the standard deviations say how well.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_planner.quaternions import integrate_rates, rotation_matrix
from aero_viz.recordings.alignment import match, place, thin
from aero_viz.recordings.poses import RecordedPoses

if TYPE_CHECKING:
    from aero_viz.recordings.recording import PointSweep, Recording

_PAIRS, _MIN_PAIRS = 12, 6
_GAPS = (2, 6)
"""Sweeps from one of a pair to the other, in turn."""
_SURFACE_POINTS, _QUERIES = 6000, 800
_ITERATIONS = 12
_STEPS = np.array([2e-3, 2e-3, 2e-3, 2e-3])
"""Steps of the numeric derivatives [s], [rad]."""
_HUBER = 0.3
"""Distance beyond which a match counts less [m]: wide enough for offsets that move points by half a metre."""
_DAMPING = np.array([1.0, 1.0, 1.0, 1.0])
"""Information that holds unobservable unknowns at zero: about one match of 1 m per second or radian."""
_CORRELATION = 50.0
"""Number of neighbouring matches that count as one, because their errors are correlated. With this value, the errors on
eight flights agree with the standard deviations."""
_SHIFTS = np.linspace(-0.2, 0.2, 17)
"""Values of tau that are tried before the search [s]."""
_LIMIT = np.array([0.3, 0.35, 0.35, 0.35])
"""Largest estimate that the search can be trusted with [s], [rad]."""

_NEGLIGIBLE = np.array([1e-3, 2e-3, 2e-3, 2e-3])
"""A step below this ends the search [s], [rad]."""


class Misalignment(NamedTuple):
    """Estimates with their standard deviations."""

    time_offset: float
    """Time to add to the stamps of the sweeps [s]."""
    time_deviation: float
    rotation: NDArray[np.float64]
    """Rotation vector [3] [rad] by which the sensor is turned against the mounting that is assumed, body axes."""
    rotation_deviation: NDArray[np.float64]
    before: float
    """Median distance of matched points from the surfaces of other sweeps [m]."""
    after: float
    """The same with the estimates applied [m]."""


class _System(NamedTuple):
    information: NDArray[np.float64]
    gradient: NDArray[np.float64]
    residuals: NDArray[np.float64]


def estimate_misalignment(recording: Recording, poses: RecordedPoses) -> Misalignment | None:
    """Return the misalignment of a recording, None if too few of its sweeps can be compared."""
    pairs = _pairs(recording)
    if len(pairs) < _MIN_PAIRS:
        return None
    costs = [_median_distance(pairs[::2], poses, shift) for shift in _SHIFTS]
    unknowns: NDArray[np.float64] = np.zeros(4)
    unknowns[0], best = _SHIFTS[int(np.argmin(costs))], None
    for _ in range(_ITERATIONS):
        system = _linearize(pairs, poses, unknowns)
        if len(system.residuals) < 100:
            return None
        cost = float(np.median(np.abs(system.residuals)))
        if best is None or cost < best[0]:
            best = (cost, unknowns, system)
        step = np.linalg.solve(system.information + np.diag(_DAMPING), system.gradient)
        unknowns = unknowns + step
        if (np.abs(unknowns) > _LIMIT).any() or (np.abs(step) < _NEGLIGIBLE).all():
            break
    assert best is not None
    cost, unknowns, system = best
    scale = 1.4826 * cost
    covariance = np.linalg.inv(system.information + np.diag(_DAMPING)) * scale**2 * _CORRELATION
    deviation = np.sqrt(np.diag(covariance))
    first = _median_distance(pairs, poses, 0.0)
    return Misalignment(float(unknowns[0]), float(deviation[0]), unknowns[1:], deviation[1:], first, cost)


def _pairs(recording: Recording) -> list[tuple[PointSweep, PointSweep]]:
    """Return pairs of thinned sweeps that are spread over the recording, in both orders; the first is the surface."""
    count, found = len(recording.sweep_times), []
    for i, start in enumerate(np.unique(np.linspace(0, max(count - 1 - _GAPS[-1], 0), _PAIRS).astype(int))):
        other = int(start) + _GAPS[i % len(_GAPS)]
        if other < count:
            sweeps = recording.sweep(int(start)), recording.sweep(other)
            for surface, query in (sweeps, sweeps[::-1]):
                found.append((thin(surface, _SURFACE_POINTS), thin(query, _QUERIES)))
    return found


def _median_distance(pairs: list[tuple[PointSweep, PointSweep]], poses: RecordedPoses, shift: float) -> float:
    """Return the median distance of matched points from the surfaces with an offset [m], infinite without matches."""
    unknowns = np.array([shift, 0.0, 0.0, 0.0])
    found = [match(_placed(surface, poses, unknowns), _placed(query, poses, unknowns)) for surface, query in pairs]
    distances = np.concatenate([matches.distances for matches in found])
    return float(np.median(np.abs(distances))) if len(distances) else np.inf


def _linearize(
    pairs: list[tuple[PointSweep, PointSweep]], poses: RecordedPoses, unknowns: NDArray[np.float64]
) -> _System:
    information, gradient, all_residuals = np.zeros((4, 4)), np.zeros(4), []
    for surface, query in pairs:
        surface_points, query_points = (_placed(sweep, poses, unknowns) for sweep in (surface, query))
        found = match(surface_points, query_points)
        jacobian = np.empty((len(found.query), 4))
        for k, step in enumerate(_STEPS):
            moved = unknowns.copy()
            moved[k] += step
            change = (_placed(query, poses, moved) - query_points)[found.query]
            change -= (_placed(surface, poses, moved) - surface_points)[found.neighbours].mean(axis=1)
            jacobian[:, k] = np.einsum("ni,ni->n", change, found.normals) / step
        weights = np.minimum(1.0, _HUBER / np.maximum(np.abs(found.distances), 1e-9))
        information += (jacobian * weights[:, None]).T @ jacobian
        gradient -= jacobian.T @ (weights * found.distances)
        all_residuals.append(found.distances)
    return _System(information, gradient, np.concatenate(all_residuals))


def _placed(sweep: PointSweep, poses: RecordedPoses, unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
    rotation = rotation_matrix(integrate_rates([1.0, 0.0, 0.0, 0.0], unknowns[1:], 1.0))
    turned = sweep._replace(points=(sweep.points @ rotation.T).astype(np.float32))
    return place(turned, poses, shift=float(unknowns[0]))
