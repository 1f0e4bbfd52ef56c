"""What planners command in ROS 2, by type of message, and the controls that make the simulated drone follow it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner import VehicleState
from aero_planner.config import VehicleConfig
from aero_planner.parameters import ParameterSection, live, text
from aero_planner.quaternions import rotate

Array = NDArray[np.float64]
_BODY_FRAMES = ("body", "base_link")
"""Frames of stamped commands that are those of the drone; every other one is the world."""
_IGNORE_RATES, _IGNORE_THRUST = 1 | 2 | 4, 64
"""Bits of mavros_msgs/AttitudeTarget.type_mask."""


@dataclass(frozen=True)
class Following(ParameterSection, section="ros"):
    """ROS 2: which commands are obeyed, and how the drone follows them."""

    topic: str = text(
        "auto", r"auto|(/[A-Za-z_]\w*)+", "auto, or the name of a topic such as /cmd_vel",
        "Topic of the commands. With auto, the usual names are listened to; the first one that is heard is obeyed "
        "until it is silent.",
    )  # fmt: skip
    timeout: float = live(0.5, "s", 0.05, 60.0, "Silence after which the drone brakes.", basic=True)
    patience: float = live(30.0, "s", 0.0, 3600.0, "Longest wait for the first command of a flight.")
    velocity_gain: float = live(3.0, "1/s", 0.1, 20.0, "Acceleration per missing velocity.", basic=True)
    position_gain: float = live(4.0, "1/s^2", 0.0, 50.0, "Acceleration per distance from a path.", basic=True)
    acceleration_max: float = live(9.0, "m/s^2", 0.5, 50.0, "Largest acceleration that follows a velocity or a path.")
    braking: float = live(3.0, "m/s^2", 0.1, 20.0, "Deceleration to the end of a path that has no times.")
    hover_thrust: float = live(0.5, "", 0.05, 0.95, "Thrust of mavros, 0 to 1, at which the drone hovers.")


@dataclass(frozen=True)
class Situation:
    """What a setpoint is followed from."""

    time: float
    """Simulated time [s]."""
    state: VehicleState
    """Estimated state."""
    following: Following
    vehicle: VehicleConfig

    def toward(self, velocity: ArrayLike, *, ahead: ArrayLike = 0.0, offset: ArrayLike = 0.0) -> Array:
        """Return the acceleration [m/s^2], [3], that follows a velocity and removes an offset, within its limit.

        Args:
            velocity: the velocity to have [m/s], [3].
            ahead: acceleration that the setpoint has itself [m/s^2], [3].
            offset: from the drone to where it should be [m], [3].
        """
        gains, missing = self.following, np.asarray(velocity) - np.asarray(self.state.velocity)
        wanted = gains.velocity_gain * missing + gains.position_gain * np.asarray(offset) + np.asarray(ahead)
        return wanted * min(1.0, gains.acceleration_max / max(float(np.linalg.norm(wanted)), 1e-9))


class Setpoint(Protocol):
    """A command as it was received."""

    @property
    def kind(self) -> str:
        """What it commands, in a word."""
        ...

    def control(self, now: Situation) -> tuple[str, Array]:
        """Return the vehicle model and its control, [4]: see `CandidatePlan.model`."""
        ...

    def path(self, now: Situation, times: Array) -> Array:
        """Return where the drone is expected at times from now [s], [n], in metres, [n, 3], world frame."""
        ...


@dataclass(frozen=True, eq=False)
class Velocity:
    """A velocity [m/s] and a yaw rate [rad/s], in the world, in the body, or by its heading alone."""

    velocity: Array
    yaw_rate: float = 0.0
    frame: str = "world"
    kind: str = "velocity"

    def _in_world(self, now: Situation) -> Array:
        if self.frame == "world":
            velocity = self.velocity
        elif self.frame == "body":
            velocity = rotate(now.state.quaternion, self.velocity)
        else:
            w, x, y, z = np.asarray(now.state.quaternion, dtype=np.float64)
            half = 0.5 * np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
            velocity = rotate((np.cos(half), 0.0, 0.0, np.sin(half)), self.velocity)
        return velocity * min(1.0, now.vehicle.speed_limit / max(float(np.linalg.norm(velocity)), 1e-9))

    def control(self, now: Situation) -> tuple[str, Array]:
        return "acceleration", np.append(now.toward(self._in_world(now)), self.yaw_rate)

    def path(self, now: Situation, times: Array) -> Array:
        return np.asarray(now.state.position) + times[:, None] * self._in_world(now)


@dataclass(frozen=True, eq=False)
class Acceleration:
    """An acceleration [m/s^2] in the world or the body, without a change of the yaw."""

    acceleration: Array
    in_body: bool = False
    kind: str = "acceleration"

    def control(self, now: Situation) -> tuple[str, Array]:
        wanted = rotate(now.state.quaternion, self.acceleration) if self.in_body else self.acceleration
        return "acceleration", np.append(wanted, 0.0)

    def path(self, now: Situation, times: Array) -> Array:
        return _ballistic(now.state, self.control(now)[1][:3], times)


@dataclass(frozen=True, eq=False)
class Rates:
    """Thrust, as a share of that of hovering, and body rates [rad/s], [3]."""

    thrust: float
    rates: Array
    kind: str = "rates"

    def _thrust(self, now: Situation) -> float:
        return self.thrust * now.vehicle.mass * now.vehicle.gravity

    def control(self, now: Situation) -> tuple[str, Array]:
        return "ctbr", np.array([self._thrust(now), *self.rates])

    def path(self, now: Situation, times: Array) -> Array:
        up = rotate(now.state.quaternion, (0.0, 0.0, self._thrust(now) / now.vehicle.mass))
        return _ballistic(now.state, up - (0.0, 0.0, now.vehicle.gravity), times)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Positions, velocities and accelerations over time, world frame, linear in between; after its end, its last point.

    Times are simulated times [s], [n]; positions [m], velocities [m/s] and accelerations [m/s^2] have shape [n, 3].
    """

    times: Array
    positions: Array
    velocities: Array
    accelerations: Array
    kind: str = "path"

    def _at(self, values: Array, times: Any) -> Array:
        return np.stack([np.interp(times, self.times, values[:, axis]) for axis in range(3)], axis=-1)

    def control(self, now: Situation) -> tuple[str, Array]:
        is_over = now.time >= self.times[-1]
        position, velocity, ahead = (
            self._at(values, now.time) for values in (self.positions, self.velocities, self.accelerations)
        )
        offset = position - np.asarray(now.state.position)
        wanted = now.toward(0.0 * velocity if is_over else velocity, ahead=0.0 if is_over else ahead, offset=offset)
        return "acceleration", np.append(wanted, 0.0)

    def path(self, now: Situation, times: Array) -> Array:
        return self._at(self.positions, now.time + times)


def _ballistic(state: VehicleState, acceleration: Array, times: Array) -> Array:
    t = times[:, None]
    return np.asarray(state.position) + t * np.asarray(state.velocity) + 0.5 * t**2 * acceleration


def timed(times: ArrayLike, positions: ArrayLike, velocities: Any = None, accelerations: Any = None) -> Trajectory:
    """Return a trajectory; velocities and accelerations that are None are those of the positions.

    Raises:
        ValueError: the times do not increase, there are fewer than two points, or a number is not finite.
    """
    t, p = np.asarray(times, dtype=np.float64), np.asarray(positions, dtype=np.float64)
    if len(t) < 2 or not (np.diff(t) > 0.0).all():
        raise ValueError("its times do not increase")
    v = np.gradient(p, t, axis=0) if velocities is None else np.asarray(velocities, dtype=np.float64)
    a = np.gradient(v, t, axis=0) if accelerations is None else np.asarray(accelerations, dtype=np.float64)
    return Trajectory(t, finite(p), finite(v), finite(a))


def along(positions: ArrayLike, now: Situation) -> Trajectory:
    """Return the trajectory along positions without times [m], [n, 3], from where they come nearest to the drone.

    It is flown at vehicle.speed_limit, and slower toward its end, where the drone stops.

    Raises:
        ValueError: there is no position, or a number is not finite.
    """
    points = finite(positions).reshape(-1, 3)
    if len(points) == 0:
        raise ValueError("it has no positions")
    own = np.asarray(now.state.position, dtype=np.float64)
    starts, ways = points, np.diff(points, axis=0, append=points[-1:])
    share = np.sum((own - starts) * ways, axis=1) / np.maximum(np.sum(ways**2, axis=1), 1e-12)
    nearest = starts + np.clip(share, 0.0, 1.0)[:, None] * ways
    first = int(np.linalg.norm(nearest - own, axis=1).argmin())
    points = np.concatenate((nearest[first : first + 1], points[first + 1 :]))
    lengths = np.linalg.norm(np.diff(points, axis=0, prepend=own[None]), axis=1)
    points, lengths = points[lengths > 1e-6], lengths[lengths > 1e-6]
    if len(points) == 0:  # the drone is there
        return timed([now.time, now.time + 1.0], [own, own])
    # Finely enough for the deceleration to show.
    ends = np.concatenate(([0.0], np.cumsum(lengths)))
    at = np.linspace(0.0, ends[-1], max(2, int(ends[-1] / 0.1) + 1))
    fine = np.stack([np.interp(at, ends, np.concatenate((own[None], points))[:, axis]) for axis in range(3)], axis=1)
    speeds = np.minimum(now.vehicle.speed_limit, np.sqrt(2.0 * now.following.braking * (ends[-1] - at)))
    steps = np.diff(at) / np.maximum(0.5 * (speeds[1:] + speeds[:-1]), 1e-3)
    return timed(now.time + np.concatenate(([0.0], np.cumsum(steps))), fine)


def finite(values: ArrayLike) -> Array:
    """Return numbers as float64; ValueError if one is not finite."""
    array = np.asarray(values, dtype=np.float64)
    if not np.isfinite(array).all():
        raise ValueError("it has numbers that are not finite")
    return array


def _twist(message: Any, now: Situation, to_time: Callable[[Any], float | None]) -> Setpoint:
    return Velocity(finite(_xyz(message.linear)), float(finite(message.angular.z)), "heading")


def _twist_stamped(message: Any, now: Situation, to_time: Callable[[Any], float | None]) -> Setpoint:
    twist, frame = message.twist, "body" if message.header.frame_id in _BODY_FRAMES else "world"
    return Velocity(finite(_xyz(twist.linear)), float(finite(twist.angular.z)), frame)


def _acceleration(message: Any, now: Situation, to_time: Callable[[Any], float | None]) -> Setpoint:
    return Acceleration(finite(_xyz(message.accel.linear)), message.header.frame_id in _BODY_FRAMES)


def _path(message: Any, now: Situation, to_time: Callable[[Any], float | None]) -> Setpoint:
    positions = [_xyz(pose.pose.position) for pose in message.poses]
    times = [to_time(pose.header.stamp) for pose in message.poses]
    if len(times) > 1 and None not in times and (np.diff(np.array(times, dtype=np.float64)) > 0.0).all():
        return timed(times, positions)  # type: ignore[arg-type]
    return along(positions, now)


def _multi_dof(message: Any, now: Situation, to_time: Callable[[Any], float | None]) -> Setpoint:
    start, points = to_time(message.header.stamp), message.points
    start = now.time if start is None else start
    times = [start + point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec for point in points]
    positions = [_xyz(point.transforms[0].translation) for point in points]
    velocities, accelerations = (
        [_xyz(getattr(point, name)[0].linear) for point in points]
        if all(getattr(point, name) for point in points)
        else None
        for name in ("velocities", "accelerations")
    )
    if len(points) == 1:  # one of a stream of setpoints, which moves on until it is too old
        ahead, rest = now.following.timeout, [[0.0, 0.0, 0.0]]
        velocities, accelerations = 2 * (velocities or rest), 2 * (accelerations or rest)
        times.append(times[0] + ahead)
        positions.append(np.add(positions[0], ahead * np.array(velocities[0])).tolist())
    return timed(times, positions, velocities, accelerations)


def _attitude_target(message: Any, now: Situation, to_time: Callable[[Any], float | None]) -> Setpoint:
    if message.type_mask & _IGNORE_THRUST:
        raise ValueError("it has no thrust")
    thrust = float(finite(message.thrust)) / now.following.hover_thrust
    if not message.type_mask & _IGNORE_RATES:
        return Rates(thrust, finite(_xyz(message.body_rate)))
    q = message.orientation
    attitude, gravity = finite((q.w, q.x, q.y, q.z)), now.vehicle.gravity
    if abs(np.linalg.norm(attitude) - 1.0) > 0.1:
        raise ValueError("its attitude is no rotation")
    up = rotate(attitude / np.linalg.norm(attitude), (0.0, 0.0, thrust * gravity))
    return Acceleration(up - (0.0, 0.0, gravity), kind="attitude")


def _xyz(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]


READERS: dict[str, Callable[[Any, Situation, Callable[[Any], float | None]], Setpoint]] = {
    "geometry_msgs/msg/Twist": _twist,
    "geometry_msgs/msg/TwistStamped": _twist_stamped,
    "geometry_msgs/msg/AccelStamped": _acceleration,
    "nav_msgs/msg/Path": _path,
    "trajectory_msgs/msg/MultiDOFJointTrajectory": _multi_dof,
    "mavros_msgs/msg/AttitudeTarget": _attitude_target,
}
"""Function that reads a command, by the type of its message. It is given the message, the present situation, and what
returns the simulated time of a stamp, None for a stamp of zero; it raises ValueError for what cannot be flown."""
TOPICS = {
    "/cmd_vel": "geometry_msgs/msg/Twist",
    "/command/velocity": "geometry_msgs/msg/TwistStamped",
    "/command/acceleration": "geometry_msgs/msg/AccelStamped",
    "/command/path": "nav_msgs/msg/Path",
    "/command/trajectory": "trajectory_msgs/msg/MultiDOFJointTrajectory",
    "/mavros/setpoint_raw/attitude": "mavros_msgs/msg/AttitudeTarget",
}
"""Type of the command on each topic with a usual name."""
