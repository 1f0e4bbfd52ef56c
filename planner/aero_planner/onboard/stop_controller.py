"""The controller that stops and levels the drone where no plan is flown."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_planner.config import VehicleConfig
from aero_planner.onboard.braking_path import BrakingPath, PathState
from aero_planner.onboard.dead_reckoning import MotionState
from aero_planner.onboard.settings import BrakeSettings
from aero_planner.quaternions import conjugate, multiply, rotate

Array = NDArray[np.float64]

_UP = np.array([0.0, 0.0, 1.0])
_MIN_LIFT = 0.3
"""Smallest vertical force while braking, as a fraction of the weight: a drone that climbs fast must not turn over."""
_MIN_UPRIGHT = 0.3
"""Cosine of the tilt below which the thrust no longer makes up for the tilt: more would push the drone aside."""
_SINK, _SINK_TIME = 0.1, 0.1
"""Speed of sinking [m/s] beyond which it is stopped with this time constant [s]."""
_CLIMB, _FLOOR_MARGIN = 0.8, 0.2
"""Speed at which the drone climbs to the floor [m/s], and height above the floor to which it climbs [m]."""
_LEVELLING_TIME = 3.0
"""Time for levelling, in time constants of the attitude: 1.5 deg remain of a tilt of 30 deg."""
_PATH_MARGIN = 1.4
"""Acceleration on a braking path, as a factor of the largest deceleration: the path itself may need as much."""

_PATH_END_SPEED = 0.3
"""Speed below which a path has ended [m/s]."""


class StopCommand(NamedTuple):
    """Command that stops the drone."""

    control: Array
    """Thrust F_t [N] and body rates omega [rad/s], shape [4], within the vehicle's bounds."""
    attitude: Array
    """Attitude to which these rates turn the drone, body to world, w x y z, shape [4]."""


class StopController:
    """Stops the drone, level, and holds its position, by thrust and body rates.

    The desired acceleration is -v / tau + k (p_hold - p), bounded, or that which follows a braking path. Height comes
    first: a drone that sinks, or is below the floor, gets the vertical acceleration that ends this, also on a path that
    descends, and the horizontal one gets what is left of the thrust. The thrust axis turns to the direction of the
    force at a rate proportional to the angle between the two. Until it is there, the thrust is that whose vertical part
    is the desired one, so that a banked drone keeps its height while it turns. The heading is not controlled.

    Args:
        vehicle: Mass, gravity and control bounds.
        settings: See `BrakeSettings`.
    """

    def __init__(self, vehicle: VehicleConfig, settings: BrakeSettings) -> None:
        self._vehicle = vehicle
        self._settings = settings

    @property
    def hover(self) -> Array:
        """Command of a level drone at rest: thrust [N] and body rates [rad/s], shape [4]."""
        return np.array([self._vehicle.mass * self._vehicle.gravity, 0.0, 0.0, 0.0])

    def level(self, motion: MotionState) -> StopCommand:
        """Return the command to hover without turning, level and with the present heading."""
        q = motion.quaternion
        return StopCommand(self.hover, self._turned(q, rotate(q, _UP), _UP)[0])

    def command(
        self,
        motion: MotionState,
        *,
        hold: Array | None = None,
        path: BrakingPath | None = None,
        floor: float = -math.inf,
        remaining: float = math.inf,
    ) -> StopCommand:
        """Return the command that stops the drone.

        Args:
            motion: Present motion.
            hold: Position to hold [m], shape [3], world frame; None only brakes.
            path: Path to brake on, if the drone is near it; None is the shortest way.
            floor: Height below which the drone climbs, world frame [m].
            remaining: Time until the last command [s], which is `level`. The end of this time is used to level the
                drone, at whatever speed it has then.
        """
        vehicle, q = self._vehicle, motion.quaternion
        if hold is not None and hold[2] < floor:
            hold = np.array([*hold[:2], floor + _FLOOR_MARGIN])
        desired = self._desired_acceleration(motion, hold, path, remaining)
        force = self._force(desired, self._least_climb(motion, floor))
        up = rotate(q, _UP)
        attitude, turn = self._turned(q, up, force / np.linalg.norm(force))
        rates = self._settings.attitude_gain * rotate(conjugate(q), turn)
        limit = vehicle.rate_xy_max
        control = np.array(
            [
                min(max(force[2] * up[2] / max(up[2], _MIN_UPRIGHT) ** 2, vehicle.thrust_min), vehicle.thrust_max),
                min(max(rates[0], -limit), limit),
                min(max(rates[1], -limit), limit),
                0.0,
            ]
        )
        return StopCommand(control, attitude)

    def _least_climb(self, motion: MotionState, floor: float) -> float:
        """Return the smallest vertical acceleration [m/s^2] that ends a fast descent, or leads back above the floor."""
        climb = float(motion.velocity[2])
        least = -(climb + _SINK) / _SINK_TIME
        if motion.position[2] >= floor:
            return least
        time = self._settings.time_constant
        wanted = min((floor + _FLOOR_MARGIN - float(motion.position[2])) / time, _CLIMB)
        return max(least, (wanted - climb) / time)

    def _force(self, desired: Array, least_climb: float) -> Array:
        """Return the force [N], shape [3], world frame; its vertical part has priority over the horizontal one."""
        vehicle = self._vehicle
        weight = vehicle.mass * vehicle.gravity
        lift = weight + vehicle.mass * max(float(desired[2]), least_climb)
        lift = min(max(lift, _MIN_LIFT * weight), vehicle.thrust_max)
        horizontal = vehicle.mass * desired[:2]
        left = math.sqrt(vehicle.thrust_max**2 - lift**2)
        return np.array([*_shortened(horizontal, left), lift])

    def _turned(self, q: Array, up: Array, direction: Array) -> tuple[Array, Array]:
        """Return the attitude after the shortest turn of the axis `up` to `direction`, and that turn [rad]."""
        axis = np.cross(up, direction)
        sine, cosine = float(np.linalg.norm(axis)), float(up @ direction)
        # Upside down, any axis will do.
        axis = axis / sine if sine > 1e-9 else rotate(q, np.array([1.0, 0.0, 0.0]))
        angle = math.atan2(sine, cosine)
        half = 0.5 * angle
        return multiply(np.array([math.cos(half), *(math.sin(half) * axis)]), q), angle * axis

    def _desired_acceleration(
        self, motion: MotionState, hold: Array | None, path: BrakingPath | None, remaining: float
    ) -> Array:
        """Return the bounded acceleration [m/s^2], shape [3], world frame."""
        settings = self._settings
        if remaining <= _LEVELLING_TIME / settings.attitude_gain:
            return np.zeros(3)
        limit, desired = settings.acceleration, -motion.velocity / settings.time_constant
        place = None if path is None else path.near(motion.position, 1.0 / settings.attitude_gain)
        if hold is not None:
            desired = desired + settings.position_gain * (hold - motion.position)
        elif place is not None:
            limit *= _PATH_MARGIN
            climb = desired[2]
            desired = self._acceleration_on_path(motion, place)
            if climb > 0.0:  # the drone sinks: its height comes before a path that descends
                desired[2] = max(desired[2], climb)
        return _shortened(desired, limit)

    def _acceleration_on_path(self, motion: MotionState, place: PathState) -> Array:
        """Return the acceleration that keeps the drone on a path and stops it there, at its end or before."""
        settings = self._settings
        offset = settings.position_gain * (place.position - motion.position)
        speed = float(np.linalg.norm(place.velocity))
        if speed < _PATH_END_SPEED:
            return offset - motion.velocity / settings.time_constant
        tangent = place.velocity / speed
        along = float(motion.velocity @ tangent)
        # Brake as hard as without a path, or harder where the path does.
        shortest = max(-along / settings.time_constant, -settings.acceleration)
        # A slower drone needs less acceleration, across the path as well.
        needed = min(max(along / speed, 0.0), 1.0) ** 2 * place.acceleration
        on_path = float(needed @ tangent) + (speed - along) / settings.time_constant
        across = needed + offset - (motion.velocity - along * tangent) / settings.time_constant
        return min(shortest, on_path) * tangent + across - float(across @ tangent) * tangent


def _shortened(vector: Array, limit: float) -> Array:
    """Return `vector`, or one of its direction whose length is `limit` if it is longer."""
    length = float(np.linalg.norm(vector))
    return vector * (limit / length) if length > limit else vector
