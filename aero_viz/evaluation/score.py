"""Metrics of a trajectory that any planner flew, by the simulator's own definitions."""

from __future__ import annotations

import csv
import io
import math
import textwrap
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aero_planner.user_file import read_user_text
from aero_viz.errors import UserError
from aero_viz.flight import FlightResult, FlightRules, VehicleModel
from aero_viz.flight.metrics import flight_results, judge_trajectory
from aero_viz.input_limits import TEXT_MAX
from aero_viz.scenes import World

_POSITION, _VELOCITY = ("x", "y", "z"), ("vx", "vy", "vz")
_MAX_MEDIAN_STEP = 0.25  # [s] between samples; too little is known about the motion between sparser ones
_MAX_STEP = 1.0  # [s] between any two samples
_MAX_TIME, _MAX_VALUE = 1e10, 1e6  # [s], [m] or [m/s]; larger numbers cannot belong to a flight


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A flown path, cubic between its samples.

    Args:
        name: name of the file.
        times: [s], increasing, shape [n], n >= 2.
        positions: [m], shape [n, 3], in the frame of the world in which it was flown.
        velocities: [m/s], shape [n, 3]; None stands for central differences of the positions.
    """

    name: str
    times: NDArray[np.float64]
    positions: NDArray[np.float64]
    velocities: NDArray[np.float64] | None = None

    def at(self, times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return positions [m] and velocities [m/s] at `times` [s], each shape [m, 3]: cubic Hermite interpolation."""
        from scipy.interpolate import CubicHermiteSpline  # takes 0.5 s to import

        velocities = self.velocities
        if velocities is None:
            velocities = np.gradient(self.positions, self.times, axis=0, edge_order=2 if len(self.times) > 2 else 1)
        curve = CubicHermiteSpline(self.times, self.positions, velocities)
        return curve(times), curve(times, 1)


def load_trajectory(path: str | Path, *, pose_topic: str | None = None) -> Trajectory:
    """Return the trajectory in a file.

    Args:
        path: CSV file with the columns t,x,y,z and optionally vx,vy,vz, or an MCAP file, ROS 2 bag or ROS 1 bag with
            Odometry or another pose topic.
        pose_topic: topic of a recording; None chooses the busiest Odometry, else the busiest other pose topic.

    Raises:
        UserError: the file cannot be read, is not a trajectory, or is too sparse. The text names file, line and column.
    """
    path = Path(path)
    trajectory = read_trajectory(path, pose_topic=pose_topic)
    steps = np.diff(trajectory.times)
    if len(steps) == 0 or np.median(steps) > _MAX_MEDIAN_STEP:
        raise UserError(
            f"{path} has {len(steps) + 1} samples over {np.sum(steps):.2f} s, too few to score: "
            f"record at least one every {_MAX_MEDIAN_STEP:g} s."
        )
    gap = int(np.argmax(steps))
    if steps[gap] > _MAX_STEP:
        since, until = trajectory.times[gap : gap + 2] - trajectory.times[0]
        raise UserError(
            f"{path} has no samples between {since:.2f} s and {until:.2f} s, too few to score: "
            f"leave no gap longer than {_MAX_STEP:g} s."
        )
    return trajectory


def read_trajectory(path: Path, *, pose_topic: str | None = None) -> Trajectory:
    """Return the trajectory in a file, however sparse; otherwise as `load_trajectory`."""
    return _read_csv(path) if path.suffix.lower() in (".csv", ".txt") else _read_recording(path, pose_topic)


def other_world(path: str | Path, world: World) -> str | None:
    """Return what to tell the user if a file is the log of a flight in another world; None if nothing is known of that.

    Raises:
        UserError: the log is damaged.
    """
    from aero_viz.logs.log_contents import is_flight_log, read_log

    own = read_log(path).world() if is_flight_log(path) else None
    if own is None:
        return None
    differing = [key for key, value in own.to_dict().items() if key != "name" and value != world.to_dict().get(key)]
    if not differing:
        return None
    return (
        f"{path} was flown in the world {own.name!r}, and is scored in {world.name!r}: they differ in their "
        f"{', '.join(differing)}."
    )


def score(
    trajectory: Trajectory, world: World, *, rules: FlightRules | None = None, planner: str = "recorded", seed: int = 0
) -> FlightResult:
    """Return the metrics of `trajectory` in `world`, as if the simulator had flown it.

    The trajectory is resampled at the ticks of `rules`, since smoothness depends on the rate, and at the integration
    steps of the simulator for the clearance. Then the simulator's own rules judge it. It ends at the first tick that
    ends a flight, or with its last sample; then `reason` is None. A CSV file of the simulator gives the metrics of its
    flight to within 1e-4, because the file has six decimals. Without measured velocities the smoothness is too small,
    because differences of positions smooth the motion.

    Args:
        trajectory: trajectory, whose first sample is the start of the flight.
        world: obstacles, goal and bounds.
        rules: when the flight ends.
        planner: name of the planner, which becomes `config` of the result.
        seed: seed of the result, which nothing else depends on.
    """
    rules = rules or FlightRules()
    start, period = trajectory.times[0], rules.period
    count = min(math.floor((trajectory.times[-1] - start) / period + 1e-6), math.ceil(rules.time_limit / period) + 1)
    positions, velocities = trajectory.at(start + period * np.arange(count + 1))
    steps = math.ceil(period / VehicleModel().step - 1e-6)
    step_times = start + period * (np.arange(count * steps) + 1) / steps
    # At the start, the simulator measures the clearance as often as at any other tick.
    step_positions = np.concatenate([np.repeat(positions[:1], steps, axis=0), trajectory.at(step_times)[0]])
    flown = np.maximum(np.arange(1 - steps, count * steps + 1) * period / steps, 0.0)
    clearance = world.distance(step_positions, flown).reshape(count + 1, steps)
    record, outcome = judge_trajectory(world, positions, velocities, clearance, rules=rules)
    ticks = int(record["ticks"][0])
    return flight_results(
        record, [outcome], [world], positions[ticks][None], rules=rules, seeds=[seed], configs=[planner], plan_ms=None
    )[0]


def _read_csv(path: Path) -> Trajectory:
    try:
        reader = csv.reader(io.StringIO(read_user_text(path, limit=TEXT_MAX), newline=""))
        lines = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not CSV text"
        raise UserError(f"Cannot read the trajectory {path}: {reason or error}.") from error
    header = [name.strip().lower() for name in lines[0][1]] if lines else []
    missing = [name for name in ("t", *_POSITION) if name not in header]
    if missing:
        raise UserError(f"{path} lacks the column {missing[0]!r} in line 1; the columns are t,x,y,z and vx,vy,vz.")
    measured = all(name in header for name in _VELOCITY)
    names = ("t", *_POSITION, *(_VELOCITY if measured else ()))
    columns = [header.index(name) for name in names]
    rows: list[list[float]] = []
    for number, row in lines[1:]:
        try:
            values = [float(row[i]) for i in columns]
        except (IndexError, ValueError):
            text = textwrap.shorten(",".join(row), 60)
            raise UserError(f"{path}, line {number}: {text!r} does not hold {len(columns)} numbers.") from None
        for name, value in zip(names, values, strict=True):
            if not abs(value) <= (_MAX_TIME if name == "t" else _MAX_VALUE):
                raise UserError(f"{path}, line {number}: {name} is {value:g}; it must be a finite number in SI units.")
        if rows and values[0] <= rows[-1][0]:
            raise UserError(f"{path}, line {number}: t does not increase.")
        rows.append(values)
    if not rows:
        raise UserError(f"{path} holds no samples below its first line.")
    table = np.array(rows)
    return Trajectory(path.name, table[:, 0], table[:, 1:4], table[:, 4:7] if measured else None)


def _read_recording(path: Path, pose_topic: str | None) -> Trajectory:
    from aero_viz.recordings.contents import read_contents
    from aero_viz.recordings.pose_messages import POSE_TYPES
    from aero_viz.recordings.poses import RecordedPoses
    from aero_viz.recordings.storage import open_storage, readable

    storage = open_storage(path)
    try:
        with readable(storage.path):
            contents = read_contents(storage)
    finally:
        storage.close()
    topics = [topic for topic in contents.topics_with(POSE_TYPES) if len(topic.poses)]
    chosen = next((topic for topic in topics if pose_topic in (None, topic.name)), None)
    if chosen is None:
        offered = ", ".join(topic.name for topic in topics) or "none"
        problem = "no topic with poses" if pose_topic is None else f"no poses on {pose_topic}"
        raise UserError(f"{path} has {problem}; topics with poses: {offered}.")
    samples = max(chosen.poses.values(), key=len)  # of several frames on one topic, the busiest one
    times, rows = samples.times(stamped=True), samples.rows()
    poses = RecordedPoses((times - times.min()) * 1e-9, rows[:, :3], rows[:, 3:7], rows[:, 7:])
    return Trajectory(path.name, poses.times, poses.positions + poses.offset, poses.velocities)
