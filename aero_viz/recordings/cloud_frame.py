"""Checks whether the clouds of a recording move with the body or stand still in the world."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from aero_planner.quaternions import conjugate, multiply, rotation_vector
from aero_viz.recordings.alignment import match, place
from aero_viz.recordings.finding import Finding
from aero_viz.recordings.poses import RecordedPoses

if TYPE_CHECKING:
    from aero_viz.recordings.recording import PointSweep, Recording

_PAIRS, _QUERIES = 5, 1000
_NEAR = 0.1
"""A point this near to a surface lies on it [m]."""
_MOVED, _TURNED = 2.0, np.radians(20.0)
"""Distance and angle between two poses that show whether the cloud moves with the body [m], [rad]."""
_LEAST = 0.1
"""Share of points on surfaces below which two sweeps do not fit."""


def check_cloud_frame(recording: Recording, poses: RecordedPoses) -> Finding | None:
    """Return what is wrong with the frame of the clouds, None if nothing is."""
    return recording.frame_fault if recording.is_in_world else _stands_still(recording, poses)


def turns_with_body(recording: Recording, poses: RecordedPoses) -> Finding | None:
    """Return a finding on clouds whose frame is said to be the world's, but which move with the body; else None."""
    as_recorded, moved = _fits(recording, poses)
    if moved <= max(_LEAST, 2.0 * as_recorded):
        return None
    return Finding(
        "body-frame",
        f"the clouds are said to be in the frame of the world, {recording.cloud_frame!r}, but turn and move with the "
        f"body: {100 * as_recorded:.0f} % of the points lie on surfaces of other sweeps as recorded and "
        f"{100 * moved:.0f} % when they are moved by the poses",
        "play with --cloud-frame body, or correct frame_id where the cloud is published",
    )


def _stands_still(recording: Recording, poses: RecordedPoses) -> Finding | None:
    """Return a finding on clouds that should move with the body, but stand still in the world; else None."""
    as_recorded, moved = _fits(recording, poses)
    if as_recorded <= max(_LEAST, 2.0 * moved):
        return None
    return Finding(
        "world-frame",
        f"the cloud is already in the world frame: of sweeps from places that are far apart, {100 * as_recorded:.0f} % "
        f"of the points lie on surfaces of each other as recorded and {100 * moved:.0f} % when they are moved by the "
        "poses",
        "play the raw cloud of the sensor (--points-topic), or this one with --cloud-frame world",
    )


def _fits(recording: Recording, poses: RecordedPoses) -> tuple[float, float]:
    """Return the shares of points that lie on surfaces of other sweeps, as recorded and when moved by the poses."""
    fits = []
    for first, second in _pairs(recording, poses):
        surface, query = recording.sweep(first), _thinned(recording.sweep(second))
        if not len(query.points) or not len(surface.points):
            continue
        clouds = [(sweep, place(sweep, poses)) for sweep in (surface, query)]
        if recording.is_in_world:  # the sweeps were moved to the body by the poses: move them back, and on
            origin = poses.offset.astype(np.float32)
            recorded = [cloud + origin for _, cloud in clouds]
            moved = [
                place(sweep._replace(points=(cloud + origin).astype(np.float32), point_times=None), poses)
                for sweep, cloud in clouds
            ]
        else:
            recorded = [sweep.points.astype(np.float64) for sweep, _ in clouds]
            moved = [cloud for _, cloud in clouds]
        fits.append((_share_on_surfaces(*recorded), _share_on_surfaces(*moved)))
    as_recorded, moved_by_poses = np.median(fits, axis=0) if fits else (0.0, 0.0)
    return float(as_recorded), float(moved_by_poses)


def _pairs(recording: Recording, poses: RecordedPoses) -> list[tuple[int, int]]:
    """Return pairs of sweeps between which the body has moved or turned."""
    positions, quaternions = poses.track.interpolate(recording.sweep_times)
    found = []
    for first in np.unique(np.linspace(0, len(positions) - 1, _PAIRS + 1).astype(int))[:_PAIRS].tolist():
        moved = np.linalg.norm(positions[first:] - positions[first], axis=1)
        turns = multiply(conjugate(quaternions[first]), quaternions[first:])
        far = np.flatnonzero((moved > _MOVED) | (np.linalg.norm(rotation_vector(turns), axis=1) > _TURNED))
        found += [(first, first + int(far[0]))] if len(far) else []
    return found


def _thinned(sweep: PointSweep) -> PointSweep:
    kept = slice(None, None, max(1, len(sweep.points) // _QUERIES))
    times = None if sweep.point_times is None else sweep.point_times[kept]
    return sweep._replace(points=sweep.points[kept], point_times=times)


def _share_on_surfaces(surface: NDArray[np.float64], points: NDArray[np.float64]) -> float:
    return float((np.abs(match(surface, points).distances) < _NEAR).sum() / len(points))
