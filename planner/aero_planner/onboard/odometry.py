"""Where the vehicle is, from an odometry of ROS 2 such as FAST-LIO2's, in place of the autopilot's own position.

All else still comes from the autopilot: modes, landed state, transmitter, battery. A position in another frame than the
autopilot's would turn attitudes and goals, so the odometry counts only while both agree.
"""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_planner.onboard.estimator_reset import EstimatorState, is_estimator_reset
from aero_planner.onboard.host_clock import HostClock
from aero_planner.onboard.interfaces import VehicleSample
from aero_planner.onboard.mavlink_state import COORDINATE_LIMIT
from aero_planner.onboard.settings import StateSettings
from aero_planner.plan import VehicleState
from aero_planner.quaternions import (
    compose_transforms,
    conjugate,
    invert_transform,
    multiply,
    quaternion_from_angles,
    rotate,
    rotation_vector,
)

Array = NDArray[np.float64]
_WAITING_MAX = 100
"""Messages that wait for the control loop; the oldest are dropped."""
_FIT_TIME = 0.25
"""Time over which positions are fitted for the velocity [s]."""
_FIT_MIN = 3
"""Smallest number of positions for it."""
_DELAY_MAX = 1.0
"""Longest delay of a message [s]: where a stamp is farther from the date, it is of another clock."""


@dataclasses.dataclass(frozen=True)
class _Measured:
    time: float
    state: VehicleState
    resets: int
    position_std: float
    velocity_std: float


class RosOdometry:
    """Replaces position, velocity and attitude of samples by those of nav_msgs/Odometry.

    Args:
        settings: Which odometry, and how it is read.
        mount: Position [m], [3], and attitude, w x y z, of the LiDAR in the body frame.
        stamps: Maps stamps to host time.
        clock: Host time [s].
        date: This computer's date [s], of which the stamps must be, where no points have stamps of the same clock: its
            delay could not be told from an offset between two clocks. None takes stamps of any clock.

    Attributes:
        dropped: Number of messages that could not be used, by reason.
    """

    def __init__(
        self,
        settings: StateSettings,
        mount: tuple[Array, Array],
        stamps: HostClock,
        clock: Callable[[], float],
        *,
        date: Callable[[], float] | None = None,
    ) -> None:
        self.dropped: dict[str, int] = {}
        self._settings, self._mount, self._stamps, self._time, self._date = settings, mount, stamps, clock, date
        self._turn = quaternion_from_angles(0.0, 0.0, settings.yaw)
        self._waiting: deque[tuple[float, float, Any]] = deque(maxlen=_WAITING_MAX)
        self._track: deque[tuple[float, Array]] = deque()
        """Times [s] and positions [m] of the last `_FIT_TIME`."""
        self._before: EstimatorState | None = None
        self._resets = 0
        self._measured: _Measured | None = None

    def receive(self, message: Any) -> None:
        """Take a message, on any thread."""
        arrival = self._time()
        self._waiting.append((arrival, math.inf if self._date is None else arrival - self._date(), message))

    def place(self, sample: VehicleSample | None) -> VehicleSample | None:
        """Return the autopilot's sample with the newest state of the odometry; None before both have arrived."""
        while self._waiting:
            try:
                self._take(*self._waiting.popleft(), sample)
            except ValueError as error:
                reason = f"{self._settings.topic} {error}"
                self.dropped[reason] = self.dropped.get(reason, 0) + 1
        if sample is None or (measured := self._measured) is None:
            return None
        return dataclasses.replace(
            sample,
            time=measured.time,
            state=measured.state,
            resets=measured.resets,
            position_std=measured.position_std,
            velocity_std=measured.velocity_std,
        )

    def _take(self, arrival: float, offset: float, message: Any, sample: VehicleSample | None) -> None:
        """Use a message; raises ValueError, which says what it is like, if it cannot be used.

        `offset` is that of host time from the date [s], infinite where stamps may be of any clock.
        """
        header, pose, twist = message.header, message.pose, message.twist
        stamp = header.stamp.sec + 1e-9 * header.stamp.nanosec
        if math.isfinite(offset) and abs(arrival - offset - stamp) > _DELAY_MAX:
            raise ValueError("with stamps of another clock than this computer's, which hides its delay")
        time = self._stamps.to_host(stamp, arrival, max_offset=offset)
        if time is None:
            raise ValueError("with an inconsistent time stamp")
        q = pose.pose.orientation
        attitude, position = np.array([q.w, q.x, q.y, q.z]), _xyz(pose.pose.position)
        linear, length = _xyz(twist.twist.linear), float(np.linalg.norm(attitude))
        if not 0.9 < length < 1.1 or not np.abs([*position, *linear]).max() <= COORDINATE_LIMIT:
            raise ValueError(f"that is not finite or beyond {COORDINATE_LIMIT:g}")
        if self._measured is not None and time <= self._measured.time:
            return  # overtaken by a newer one
        position, attitude = compose_transforms(np.zeros(3), self._turn, *self._of_body(position, attitude / length))
        before = self._before
        rates = np.zeros(3)
        if before is not None and time > before.time:
            rates = rotation_vector(multiply(conjugate(before.attitude), attitude)) / (time - before.time)
        after = EstimatorState(time, position, np.zeros(3) if before is None else before.velocity, attitude, rates)
        if before is not None and is_estimator_reset(before._replace(rates=rates), after):
            self._resets += 1
            self._track.clear()
        position_std = _std(pose.covariance)
        velocity, velocity_std = self._velocity(time, position, attitude, linear)
        self._before = None if velocity is None else after._replace(velocity=velocity)
        if velocity is None:
            return  # the first positions
        if self._settings.velocity != "positions":
            velocity_std = _std(twist.covariance)
        state = VehicleState(position, velocity, attitude, time=time)
        if sample is not None:
            self._compare(time, state, sample)
        self._measured = _Measured(time, state, self._resets, position_std, velocity_std)

    def _of_body(self, position: Array, attitude: Array) -> tuple[Array, Array]:
        """Return the pose of the body, where that of the sensor is given.

        Such an odometry begins with the pose of the sensor as its origin; the world begins with that of the body.
        """
        if self._settings.pose == "body":
            return position, attitude
        moved = compose_transforms(*self._mount, position, attitude)
        return compose_transforms(*moved, *invert_transform(*self._mount))

    def _velocity(self, time: float, position: Array, attitude: Array, linear: Array) -> tuple[Array | None, float]:
        """Return the velocity [m/s], [3], world frame, and its standard deviation; None while it is unknown.

        The deviation is that of a fit of the positions, by their scatter about it; NaN with too few of them.
        """
        self._track.append((time, position))
        while time - self._track[0][0] > _FIT_TIME:
            self._track.popleft()
        fitted, std = None, math.nan
        if len(self._track) >= _FIT_MIN:
            ages = np.array([at for at, _ in self._track]) - time
            terms = np.stack((np.ones_like(ages), ages, ages**2), axis=1)
            # Scaled, so that the sums are well conditioned.
            scaled = terms / (1.0, _FIT_TIME, _FIT_TIME**2)
            inverse = np.linalg.pinv(scaled)
            places = np.stack([place for _, place in self._track])
            fitted = inverse[1] @ places / _FIT_TIME
            if (spare := len(places) - _FIT_MIN) > 0:
                scatter = float(np.sum((places - scaled @ (inverse @ places)) ** 2)) / (3.0 * spare)
                std = math.sqrt(scatter) * float(np.linalg.norm(inverse[1])) / _FIT_TIME
        if self._settings.velocity == "positions":
            return fitted, std
        if not linear.any() and fitted is not None and np.linalg.norm(fitted) > 1.0:
            raise ValueError("without a velocity while it moves: set state.velocity to positions")
        return rotate(attitude if self._settings.velocity == "body" else self._turn, linear), math.nan

    def _compare(self, time: float, state: VehicleState, sample: VehicleSample) -> None:
        """Raise ValueError if the autopilot is elsewhere, or turned otherwise, by its own estimate."""
        own = sample.state
        expected = np.asarray(own.position) + (time - sample.time) * np.asarray(own.velocity)
        distance = float(np.linalg.norm(np.asarray(state.position) - expected))
        turn = np.linalg.norm(rotation_vector(multiply(conjugate(own.quaternion), state.quaternion)))
        if not distance <= self._settings.agree_distance:
            raise ValueError(f"more than {self._settings.agree_distance:g} m from the autopilot's own position")
        if not math.degrees(float(turn)) <= self._settings.agree_angle:
            raise ValueError(f"turned by more than {self._settings.agree_angle:g} deg from the autopilot's attitude")


def _xyz(vector: Any) -> Array:
    return np.array([vector.x, vector.y, vector.z], dtype=np.float64)


def _std(covariance: Any) -> float:
    """Return the largest standard deviation of x, y and z in a 6 x 6 covariance; NaN if unknown, which is 0 or less."""
    known = [float(covariance[i]) for i in (0, 7, 14) if covariance[i] > 0.0]
    return math.sqrt(max(known)) if known else math.nan
