"""Check of given poses: the motion that they tell against that which the sweeps themselves show."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aero_planner.quaternions import quaternion_of_matrix, rotation_matrix, rotation_vector
from aero_viz.recordings.finding import Finding
from aero_viz.recordings.localization import in_body, near, pose_matrix
from aero_viz.recordings.odometry import Motion, OdometryProgress
from aero_viz.recordings.poses import RecordedPoses
from aero_viz.recordings.recording import Recording
from aero_viz.recordings.registration import Surface

Array = NDArray[np.float64]

_BY_SWEEPS = "the registration of each sweep with those before"
_SWEEPS_BEFORE = 5
"""Each sweep is registered with that many before it."""
_POINTS_MIN = 1000
"""A sweep of fewer points is too sparse a surface for the next one."""
_FITNESS_MIN = 0.5
"""A sweep sees much that those before have not seen, and starts near its true pose."""
_CHECKED_MIN = 0.5
"""Share of the sweeps that must be registered, or else the drift is not known."""
_STEP, _STEP_TURN = 0.3, 3.0
"""Largest disagreement between two neighbouring sweeps that registration itself may cause [m], [deg]."""
_DRIFT, _DRIFT_SHARE = 0.3, 0.03
"""Largest drift that registration itself may cause [m], and as a share of the way."""
_TURN, _TURN_PER_METRE = 2.0, 0.05
"""The same for the heading and the tilt [deg], [deg/m]."""


@dataclass(frozen=True)
class PoseCheck:
    """Disagreement between the poses of a recording and a registration of its sweeps."""

    reference: str
    """What the sweeps were registered with."""
    sweeps: int
    checked: int
    """Sweeps that were registered and can be trusted."""
    fitness: float
    """Median share of the points of a registered sweep that lie on the surfaces."""
    way_m: float
    """Way of the body by the poses."""
    drift_m: float
    """Distance between both motions at the end, if they are the same at the start."""
    drift_deg: float
    """Angle between both attitudes at the end."""
    step_m: float
    """Largest disagreement about the way from one sweep to the next that was registered."""
    step_deg: float
    step_at_s: float
    """Time of the larger one of the two, in relation to what is tolerated."""
    unchecked: tuple[str, ...]
    """Why sweeps could not be checked, one sentence each."""

    @property
    def is_known(self) -> bool:
        """True if enough sweeps were registered."""
        return self.checked >= 2 and self.checked >= _CHECKED_MIN * self.sweeps

    def format_line(self) -> str:
        """Return the check as one line of text."""
        what = f"poses checked by {self.reference}: {self.checked} of {self.sweeps} sweeps, fit {self.fitness:.0%}"
        if not self.is_known:
            return f"{what}; too few to tell"
        return (
            f"{what}; {self._drift()}; largest disagreement between two sweeps {self.step_m:.2f} m, "
            f"{self.step_deg:.1f} deg, at {self.step_at_s:.1f} s"
        )

    def finding(self) -> Finding | None:
        """Return the fault of the poses; None if they agree with the sweeps, or if it is not known."""
        if not self.is_known:
            return None
        drifts = self.drift_m > max(_DRIFT, _DRIFT_SHARE * self.way_m) or (
            self.drift_deg > _TURN + _TURN_PER_METRE * self.way_m
        )
        jumps = self.step_m > _STEP or self.step_deg > _STEP_TURN
        if not (drifts or jumps):
            return None
        parts = [self._drift()] if drifts else []
        if jumps:
            parts.append(f"at {self.step_at_s:.1f} s they are {self.step_m:.2f} m and {self.step_deg:.1f} deg off")
        return Finding(
            "pose-drift",
            f"the poses disagree with {self.reference} (fit {self.fitness:.0%}): {' and '.join(parts)}",
            "calibrate the odometry, or play with --odometry auto or kiss-icp, or with --map",
        )

    def _drift(self) -> str:
        share = f" ({self.drift_m / self.way_m:.1%})" if self.way_m > 1.0 else ""
        return f"drift {self.drift_m:.2f} m{share} and {self.drift_deg:.1f} deg after {self.way_m:.1f} m"


def check_by_sweeps(
    recording: Recording, poses: RecordedPoses, progress: OdometryProgress = lambda done, total: None
) -> PoseCheck:
    """Return how the poses agree with a registration of each sweep with the five before it."""
    count = len(recording.sweep_times)
    before: deque[Array] = deque(maxlen=_SWEEPS_BEFORE)
    times: list[float] = []
    registered: list[Array] = []
    fitness, unchecked = [], []
    last: tuple[Array, Array] | None = None
    for index in range(count):
        sweep = near(recording.sweep(index))
        given = pose_matrix(poses, sweep.time)
        points = in_body(sweep, poses, sweep.time)
        pose = given if last is None else last[1] @ np.linalg.inv(last[0]) @ given
        if len(points) < _POINTS_MIN:
            unchecked.append(f"sweep {index} at {sweep.time:.1f} s has only {len(points)} points")
        elif before:
            fit = Surface(np.concatenate(before)).fit(points, pose)
            if problem := fit.problem(least=_FITNESS_MIN):
                unchecked.append(f"sweep {index} at {sweep.time:.1f} s: {problem}")
            else:
                pose = fit.pose
                fitness.append(fit.fitness)
                times.append(sweep.time)
                registered.append(pose)
        elif not times:
            times.append(sweep.time)
            registered.append(pose)
        if len(points) >= _POINTS_MIN:
            before.append(points @ pose[:3, :3].T + pose[:3, 3])
        last = given, pose
        progress(index + 1, count)
    median = float(np.median(fitness)) if fitness else 0.0
    return _compare(_BY_SWEEPS, poses, np.array(times), np.array(registered), median, count, unchecked)


def check_by_map(poses: RecordedPoses, motion: Motion, sweeps: int) -> PoseCheck:
    """Return how the poses of a recording with a number of `sweeps` agree with its motion in a map."""
    inside = poses.covers(motion.times)
    matrices = np.tile(np.eye(4), (int(inside.sum()), 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = rotation_matrix(motion.quaternions[inside]), motion.positions[inside]
    return _compare("the map", poses, motion.times[inside], matrices, motion.fitness, sweeps, motion.problems)


def _compare(
    reference: str,
    poses: RecordedPoses,
    times: Array,
    registered: Array,
    fitness: float,
    sweeps: int,
    unchecked: Sequence[str],
) -> PoseCheck:
    """Return the check of poses against registered ones [n, 4, 4] at `times` [n] [s]."""
    if len(times) < 2:
        return PoseCheck(reference, sweeps, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, tuple(unchecked))
    given = np.array([pose_matrix(poses, when) for when in times])
    drift, turn = _disagreement(given[[0]], given[[-1]], registered[[0]], registered[[-1]])
    steps, turns = _disagreement(given[:-1], given[1:], registered[:-1], registered[1:])
    worst = int(np.argmax(np.maximum(steps / _STEP, turns / _STEP_TURN)))
    way = float(np.linalg.norm(np.diff(given[:, :3, 3], axis=0), axis=1).sum())
    return PoseCheck(
        reference=reference,
        sweeps=sweeps,
        checked=len(times),
        fitness=round(fitness, 3),
        way_m=round(way, 3),
        drift_m=round(float(drift[0]), 3),
        drift_deg=round(float(turn[0]), 2),
        step_m=round(float(steps[worst]), 3),
        step_deg=round(float(turns[worst]), 2),
        step_at_s=round(float(times[worst + 1]), 3),
        unchecked=tuple(unchecked),
    )


def _disagreement(given_from: Array, given_to: Array, from_: Array, to: Array) -> tuple[Array, Array]:
    """Return by how much motions [n, 4, 4] between two poses differ from others, [n] [m] and [n] [deg]."""
    one, other = np.linalg.inv(given_from) @ given_to, np.linalg.inv(from_) @ to
    turn = quaternion_of_matrix(np.swapaxes(one[:, :3, :3], 1, 2) @ other[:, :3, :3])
    distance = np.linalg.norm(one[:, :3, 3] - other[:, :3, 3], axis=1)
    return distance, np.degrees(np.linalg.norm(rotation_vector(turn), axis=1))
