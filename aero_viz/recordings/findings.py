"""Checks of a recording: faults that falsify the planner's view without raising an error, each with its evidence."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from aero_planner.quaternions import conjugate, multiply, rotate, rotation_vector
from aero_viz.recordings.alignment import place
from aero_viz.recordings.cloud_frame import check_cloud_frame
from aero_viz.recordings.finding import Finding
from aero_viz.recordings.misalignment import Misalignment, estimate_misalignment
from aero_viz.recordings.poses import RecordedPoses, position_differences

if TYPE_CHECKING:
    from aero_viz.recordings.recording import Recording

_SAMPLES = 20
_MOVED = 2.0
"""Least way of a body that shows which points move with it [m]."""
_MOVING = 0.5
"""Speed from which the direction of a velocity counts [m/s]."""
_AIRFRAME_RANGE, _AIRFRAME_CELL, _AIRFRAME_SHARE = 1.0, 0.05, 0.7
"""Points nearer than the range belong to the body if they stay in one cell of this size, body frame, in this share of
the sweeps while it moves [m], [m]."""
_BURST = 1e-3
"""Sweeps that follow one another faster belong to one cloud: a flight log starts with several [s]."""
GAP = 1.6
"""A gap between two sweeps that is longer than this many median periods lacks at least one sweep."""
_PAUSE = 60.0
"""Recorders that lose sweeps go on sooner [s]."""
_TILES = ("las", "laz")
"""Formats of tiles of maps, whose unit is known."""
_FAR = 1000.0
"""Half of the points of a LiDAR are nearer [m]."""
_FLAT = 0.02
"""Thickness below which the points of a sweep lie in a plane [m], or as a share of the width."""
_JUMP, _TURN = 0.5, np.radians(25.0)
_MIN_TIME_OFFSET, _MIN_ROTATION = 0.008, np.radians(0.8)
_CERTAIN = 5.0
"""An estimate is significant if it is at least this many standard deviations from zero."""
_IMPROVEMENT = 0.9
_COLUMN, _MIN_COLUMNS, _FLOOR_SHARE, _BELOW = 1.0, 20, 0.75, 0.2
"""Of the ground: width of a column of points [m], least number of columns that are mostly ground, least share of the
points in those, and largest share of points below it."""


@dataclass(frozen=True)
class Measured:
    """Properties of a recording; None where they cannot be measured."""

    sweep_rate: float | None
    """[Hz]."""
    pose_rate: float | None
    """[Hz]."""
    range_m: tuple[float, float] | None
    """1st and 99th percentile of the ranges [m]."""
    elevation_deg: tuple[float, float] | None
    """1st and 99th percentile of the elevations in the body frame [deg]."""
    azimuth_deg: float | None
    """Share of the full circle in which there are points, as an angle [deg]."""
    ground_height: float | None
    """Height of the ground in the frame of the poses [m]."""
    timed_points: bool
    """True if points have times."""

    def format_line(self) -> str:
        """Return the properties as one line of text."""
        parts = []
        if self.sweep_rate:
            parts.append(f"sweeps at {self.sweep_rate:.1f} Hz, points with{'' if self.timed_points else 'out'} times")
        if self.pose_rate:
            parts.append(f"poses at {self.pose_rate:.1f} Hz")
        if self.range_m and self.elevation_deg:
            (near, far), (low, high) = self.range_m, self.elevation_deg
            parts.append(f"range {near:.1f} to {far:.1f} m, elevation {low:.0f} to {high:.0f} deg")
        if self.azimuth_deg:
            parts.append(f"azimuth {self.azimuth_deg:.0f} deg")
        if self.ground_height is not None:
            parts.append(f"ground at z = {self.ground_height:.1f} m")
        elif self.pose_rate:
            parts.append("no level ground seen, so its height is unknown")
        return "; ".join(parts)


def measure(recording: Recording) -> Measured:
    """Return rates, range, field of view and ground height of a recording."""
    sweeps = [recording.sweep(i) for i in _sampled(len(recording.sweep_times))]
    points = np.concatenate([sweep.points for sweep in sweeps]).astype(np.float64)
    ranges = np.linalg.norm(points, axis=1)
    near = field = circle = None
    if len(points):
        first, last = np.percentile(ranges, [1, 99])
        low, high = np.percentile(np.degrees(np.arcsin(np.clip(points[:, 2] / ranges, -1, 1))), [1, 99])
        near, field = (float(first), float(last)), (float(low), float(high))
        azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0])) // 5.0
        circle = min(5.0 * len(np.unique(azimuth)), 360.0)
    times = None if recording.poses is None else recording.poses.times
    return Measured(
        _rate(_sweep_starts(recording)),
        None if times is None else _rate(times),
        near,
        field,
        circle,
        _ground(recording),
        any(sweep.point_times is not None for sweep in sweeps),
    )


def find_faults(recording: Recording) -> list[Finding]:
    """Return the findings on a recording, faults first."""
    found = [*_dropped_sweeps(recording), *_units(recording)]
    poses = recording.poses
    if poses is None or recording.pose_origin == "odometry":
        return found
    found += _jumps(poses)
    found += check_twists(poses)
    found += _airframe(recording, poses)
    frame = check_cloud_frame(recording, poses)
    fixed = [] if frame is None else [frame]
    # Sweeps that do not move with the body, or poses that jump, say nothing about offsets.
    if not fixed and not any(finding.code == "pose-jumps" for finding in found):
        estimate = None if _is_flat(recording) else estimate_misalignment(recording, poses)
        found += [] if estimate is None else _offsets(estimate, _turn_during_sweep(recording, poses))
    return sorted(fixed + found, key=lambda finding: not finding.is_fault)


def _sampled(count: int) -> list[int]:
    return [int(i) for i in np.unique(np.linspace(0, count - 1, _SAMPLES).astype(int))]


def _rate(times: NDArray[np.float64]) -> float | None:
    """Return how many follow one another in a second [Hz]. The first step may be shorter, after a partial sweep."""
    steps = np.diff(times)
    steps = steps[1:] if len(steps) > 1 else steps
    return float(1.0 / np.median(steps)) if len(steps) and np.median(steps) > 0.0 else None


def _sweep_starts(recording: Recording) -> NDArray[np.float64]:
    """Return the times of the sweeps [s]; of sweeps that were written as one cloud, only the last."""
    times = recording.sweep_times
    return times[np.append(np.diff(times) > _BURST, True)]


def _dropped_sweeps(recording: Recording) -> Iterator[Finding]:
    times = _sweep_starts(recording)
    steps = np.diff(times)
    if len(steps) < 4:
        return
    period = float(np.median(steps))
    for at in np.flatnonzero(steps > _PAUSE)[:1]:
        yield Finding(
            "clock-jump",
            f"the time jumps by {steps[at]:.1f} s after the sweep at {times[at]:.1f} s; a sweep takes {period:.2f} s",
            "if the recording was not paused there, a clock was set: synchronize the sensor's clock before you record",
        )
    gaps = np.flatnonzero((steps > GAP * period) & (steps <= _PAUSE))
    if period > 0.0 and len(gaps):
        missing, longest = int(np.round(steps[gaps] / period - 1.0).sum()), float(steps[gaps].max())
        yield Finding(
            "dropped-sweeps",
            f"about {missing} of {len(steps) + 1 + missing} sweeps are missing: {len(gaps)} gaps, the longest "
            f"{longest:.2f} s after {times[gaps[np.argmax(steps[gaps])]]:.1f} s, where a sweep "
            f"takes {period:.2f} s",
            "record to a faster disk or with a larger queue, and check the network of the sensor",
        )


def _units(recording: Recording) -> Iterator[Finding]:
    sweeps = [recording.sweep(i) for i in _sampled(len(recording.sweep_times))]
    ranges = np.linalg.norm(np.concatenate([sweep.points for sweep in sweeps]), axis=1)
    if len(ranges) and np.median(ranges) > _FAR:
        dropped = sum(sweep.dropped for sweep in sweeps)
        is_tile = recording.format in _TILES
        yield Finding(
            "units",
            f"half of the points are farther away than {np.median(ranges):.0f} m, and "
            f"{100 * dropped / (dropped + len(ranges)):.0f} % are left out because they are invalid or beyond 10 km",
            f"this is a map and no sweep; fly through it with `aero-viz demo {recording.path.name}`"
            if is_tile
            else "convert the coordinates to metres where the cloud is published; they are probably millimetres",
        )


def _jumps(poses: RecordedPoses) -> Iterator[Finding]:
    steps = np.diff(poses.times)
    if len(steps) < 5:
        return
    moved = np.linalg.norm(np.diff(poses.positions, axis=0), axis=1)
    turned = np.linalg.norm(rotation_vector(multiply(conjugate(poses.quaternions[:-1]), poses.quaternions[1:])), axis=1)
    jumps = np.zeros(len(steps), bool)
    for amount, least in ((moved, _JUMP), (turned, _TURN)):
        rate = amount / steps
        around = np.array([np.median(rate[max(0, i - 5) : i + 6]) for i in range(len(rate))])
        jumps |= (amount > least) & (rate > 4.0 * around) & (amount - around * steps > least)
    if jumps.any():
        at = int(np.flatnonzero(jumps)[np.argmax(moved[jumps])])
        yield Finding(
            "pose-jumps",
            f"the poses jump {int(jumps.sum())} times, by up to {moved[at]:.2f} m and {np.degrees(turned[at]):.0f} deg "
            f"within {1e3 * steps[at]:.0f} ms at {poses.times[at]:.1f} s",
            "play the odometry instead of a localization that corrects itself (--pose-topic), or --odometry auto",
        )


def check_twists(poses: RecordedPoses) -> Iterator[Finding]:
    """Yield what is wrong with the recorded velocities."""
    twists = poses.twists
    if twists is None or not np.isfinite(twists).all():
        return
    true = position_differences(poses.times, poses.positions)
    moving = np.linalg.norm(true, axis=1) > _MOVING
    if moving.sum() < 5:
        return
    speed = float(np.median(np.linalg.norm(true[moving], axis=1)))
    if not twists.any():
        yield Finding(
            "twist-zero",
            f"the twist of all {len(twists)} poses is zero, but the body moves at {speed:.1f} m/s",
            "nothing: velocities are computed from the positions; on board, the estimator must fill in the twist",
            is_fault=False,
        )
        return
    as_body = float(np.median(np.linalg.norm((rotate(poses.quaternions, twists) - true)[moving], axis=1)))
    as_world = float(np.median(np.linalg.norm((twists - true)[moving], axis=1)))
    if as_body > max(0.3, 0.15 * speed):
        if as_world < 0.5 * as_body:
            yield Finding(
                "twist-frame",
                f"the twist is in the world frame: read so, it differs from the motion by {as_world:.2f} m/s, read in "
                f"the body frame as nav_msgs/Odometry demands, by {as_body:.2f} m/s",
                "rotate the twist into child_frame_id where it is published",
            )
        else:
            yield Finding(
                "twist-wrong",
                f"the twist differs from the motion by {as_body:.2f} m/s at {speed:.1f} m/s, in the world frame by "
                f"{as_world:.2f} m/s",
                "check the unit, the axes and the frame of the twist where it is published",
            )


def _airframe(recording: Recording, poses: RecordedPoses) -> Iterator[Finding]:
    sampled = _sampled_on_the_way(poses.track.interpolate(recording.sweep_times)[0])
    if len(sampled) < 5:
        return
    counts: dict[tuple[int, ...], int] = {}
    for index in sampled:
        points = recording.sweep(index).points
        points = points[np.linalg.norm(points, axis=1) < _AIRFRAME_RANGE]
        for cell in map(tuple, np.unique(np.floor(points / _AIRFRAME_CELL).astype(int), axis=0).tolist()):
            counts[cell] = counts.get(cell, 0) + 1
    fixed = np.array([cell for cell, count in counts.items() if count >= _AIRFRAME_SHARE * len(sampled)])
    if not len(fixed):
        return
    lower, upper = fixed.min(axis=0) * _AIRFRAME_CELL, (fixed.max(axis=0) + 1) * _AIRFRAME_CELL
    box = " ".join(f"{value:.2f}" for value in (*lower, *upper))
    yield Finding(
        "airframe",
        f"the LiDAR sees the drone itself: {len(fixed)} cells of {100 * _AIRFRAME_CELL:.0f} cm within "
        f"{_AIRFRAME_RANGE:.0f} m stay where they are in the body frame while it moves",
        f"mask the box from ({lower[0]:.2f}, {lower[1]:.2f}, {lower[2]:.2f}) to ({upper[0]:.2f}, {upper[1]:.2f}, "
        f"{upper[2]:.2f}) m: play with --mask {box}",
    )


def _sampled_on_the_way(positions: NDArray[np.float64]) -> list[int]:
    """Return sweeps at equal distances along the way of the body, none if it stays within `_MOVED`.

    What is near a body at rest stays where it is in the body frame as the body itself does.

    Args:
        positions: positions of the sweeps [m], shape [n, 3].
    """
    if np.linalg.norm(np.ptp(positions, axis=0)) < _MOVED:
        return []
    way = np.append(0.0, np.linalg.norm(np.diff(positions, axis=0), axis=1).cumsum())
    return np.unique(np.searchsorted(way, np.linspace(0.0, way[-1], _SAMPLES))).tolist()


def _is_flat(recording: Recording) -> bool:
    """Return True if most sweeps lie in a plane, as those of a planar scanner do, and show no surfaces."""
    flat = []
    for index in _sampled(len(recording.sweep_times)):
        points = recording.sweep(index).points.astype(np.float64)
        if len(points) > 2:
            spread = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(points.T)), 0.0))
            flat.append(spread[0] < max(_FLAT, _FLAT * spread[1]))
    return bool(flat) and bool(np.mean(flat) > 0.5)


def _turn_during_sweep(recording: Recording, poses: RecordedPoses) -> float:
    """Return the angle by which the body usually turns during a sweep whose points have no times [rad]."""
    times = recording.sweep_times
    if len(times) < 2 or any(recording.sweep(i).point_times is not None for i in (0, len(times) // 2)):
        return 0.0
    _, quaternions = poses.track.interpolate(times)
    turns = rotation_vector(multiply(conjugate(quaternions[:-1]), quaternions[1:]))
    return float(np.median(np.linalg.norm(turns, axis=1)))


def _offsets(estimate: Misalignment, turn: float) -> Iterator[Finding]:
    """Yield findings on the offsets; turning by the angle `turn` [rad] during a sweep looks like a wrong mounting."""
    if estimate.after > _IMPROVEMENT * estimate.before:
        return
    evidence = f"points then lie {100 * estimate.after:.1f} instead of {100 * estimate.before:.1f} cm from the surfaces"
    offset = estimate.time_offset
    if abs(offset) > max(_MIN_TIME_OFFSET, _CERTAIN * estimate.time_deviation):
        late = "early" if offset > 0.0 else "late"
        yield Finding(
            "time-offset",
            f"the sweeps are stamped {1e3 * abs(offset):.0f} ms too {late} (+-{1e3 * estimate.time_deviation:.0f} ms): "
            + evidence,
            "synchronize the clocks of sensor and estimator (PTP), or correct the stamps where they are published",
        )
    angle = np.abs(estimate.rotation)
    if (angle > np.maximum(_MIN_ROTATION + turn, _CERTAIN * estimate.rotation_deviation)).any():
        roll, pitch, yaw = np.degrees(estimate.rotation)
        yield Finding(
            "extrinsic",
            f"walls are doubled: the sensor is turned by roll {roll:.1f}, pitch {pitch:.1f}, yaw {yaw:.1f} deg against "
            f"its recorded mounting; {evidence}",
            "calibrate the mounting and record it in /tf_static, or give it with --extrinsic",
        )


def _ground(recording: Recording) -> float | None:
    """Return the height of the largest level surface below the body, None if there is none."""
    poses, below = recording.poses, []
    if poses is None:
        return None
    for index in _sampled(len(recording.sweep_times)):
        sweep = recording.sweep(index)
        points = place(sweep, poses)
        here = poses.track.interpolate(sweep.time)[0]
        near = (np.linalg.norm(points[:, :2] - here[:2], axis=1) < 20.0) & (points[:, 2] < here[2] - 0.2)
        below.append(points[near])
    all_below = np.concatenate(below)
    heights = all_below[:, 2]
    if len(heights) < 100:
        return None
    counts, edges = np.histogram(heights, np.arange(heights.min(), heights.max() + 0.2, 0.1))
    best = int(np.argmax(counts))
    if counts[best] < 0.1 * len(heights):
        return None
    inside = (heights >= edges[max(best - 1, 0)]) & (heights <= edges[min(best + 2, len(edges) - 1)])
    if (heights < edges[max(best - 1, 0)]).mean() > _BELOW or not _is_level(all_below, inside):
        return None
    return float(np.median(heights[inside]) + poses.offset[2])


def _is_level(points: NDArray[np.float64], inside: NDArray[np.bool_]) -> bool:
    """Return True if the points `inside` a band of heights are those of a floor, and not the lower part of walls.

    A wall has points at other heights in the same column.
    """
    _, column = np.unique(np.floor(points[:, :2] / _COLUMN), axis=0, return_inverse=True)
    column = column.ravel()  # NumPy 2.0 keeps an axis
    is_floor = np.bincount(column, inside) > 0.5 * np.bincount(column)
    return is_floor.sum() >= _MIN_COLUMNS and is_floor[column[inside]].mean() > _FLOOR_SHARE
