"""The true pose of the vehicle that PX4 simulates, in the rig's world frame."""

from __future__ import annotations

import bisect
import math
from collections import deque
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from aero_planner.onboard.frames import attitude_from_ned, world_from_ned
from aero_planner.quaternions import conjugate, multiply, quaternion_from_angles, rotate

_EARTH_RADIUS = 6_371_000.0  # [m], as in PX4's map projection

Place = tuple[float, float, float]
"""Latitude [deg], longitude [deg], altitude [m]."""


class Truth(NamedTuple):
    """True state of the vehicle, world frame."""

    time: float
    """PX4's simulated time [s]."""
    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    quaternion: NDArray[np.float64]
    """Body to world, w x y z."""


class PosedVehicle:
    """The pose of the vehicle before and after a step, as arrays for the LiDAR."""

    def __init__(self) -> None:
        self.position, self.position_before = (wp.zeros(1, dtype=wp.vec3, device="cpu") for _ in range(2))
        identity = [(1.0, 0.0, 0.0, 0.0)]
        self.quaternion, self.quaternion_before = (wp.array(identity, dtype=wp.vec4, device="cpu") for _ in range(2))

    def move(self, truth: Truth) -> None:
        """Set the pose."""
        wp.copy(self.position_before, self.position)
        wp.copy(self.quaternion_before, self.quaternion)
        position: Any = self.position.numpy()
        quaternion: Any = self.quaternion.numpy()
        position[0], quaternion[0] = truth.position, truth.quaternion


class TruthTracker:
    """Turns HIL_STATE_QUATERNION, which has no time, and the SYSTEM_TIME that follows it, into true states.

    Args:
        origin: where the vehicle stands [m], shape [3], world frame.
        heading: direction of PX4's north, world frame [rad].

    Attributes:
        time: PX4's newest simulated time [s]; -inf before the first one.
        home: where the vehicle stands; None before the first message.
    """

    def __init__(self, origin: NDArray[np.float64], heading: float) -> None:
        self.time = -math.inf
        self.home: Place | None = None
        self._origin, self._turn = origin, quaternion_from_angles(0.0, 0.0, math.degrees(heading))
        self._hil: Any = None
        self._truths: deque[Truth] = deque(maxlen=500)

    def add_state(self, message: Any) -> None:
        """Take a HIL_STATE_QUATERNION."""
        self._hil = message

    def add_time(self, message: Any) -> None:
        """Take a SYSTEM_TIME."""
        self.time = 1e-3 * message.time_boot_ms
        if self._hil is None:
            return
        hil, self._hil = self._hil, None
        place = 1e-7 * hil.lat, 1e-7 * hil.lon, 1e-3 * hil.alt
        self.home = self.home or place
        position = self._origin + rotate(self._turn, _way(self.home, place))
        velocity = rotate(self._turn, world_from_ned([1e-2 * hil.vx, 1e-2 * hil.vy, 1e-2 * hil.vz]))
        attitude = multiply(self._turn, attitude_from_ned(hil.attitude_quaternion))
        self._truths.append(Truth(self.time, position, velocity, attitude))

    @property
    def newest(self) -> Truth:
        """The newest true state; before the first one, the vehicle is at rest."""
        return self._truths[-1] if self._truths else Truth(0.0, self._origin, np.zeros(3), self._turn)

    def at(self, time: float) -> Truth:
        """Return the true state at a time of PX4 [s], interpolated between the two nearest ones."""
        if len(self._truths) < 2:
            return self.newest
        after = bisect.bisect_left(self._truths, time, key=lambda truth: truth.time)
        after = min(max(after, 1), len(self._truths) - 1)
        first, second = self._truths[after - 1], self._truths[after]
        part = min(max((time - first.time) / max(second.time - first.time, 1e-6), 0.0), 1.0)
        sign = math.copysign(1.0, float(first.quaternion @ second.quaternion))
        attitude = (1.0 - part) * first.quaternion + part * sign * second.quaternion
        return Truth(
            time,
            first.position + part * (second.position - first.position),
            first.velocity + part * (second.velocity - first.velocity),
            attitude / np.linalg.norm(attitude),
        )

    def local(self, position: NDArray[np.float64], origin: Place | None) -> NDArray[np.float64]:
        """Return a position [m], shape [3], world frame, in PX4's local frame, north-west-up.

        `origin` is that of the local frame; None stands for the place where the vehicle stood.
        """
        shift = np.zeros(3) if origin is None or self.home is None else _way(self.home, origin)
        return rotate(conjugate(self._turn), position - self._origin) - shift


def _way(start: Place, end: Place) -> NDArray[np.float64]:
    """Return the way between two places near each other [m], shape [3], north-west-up."""
    north = math.radians(end[0] - start[0]) * _EARTH_RADIUS
    east = math.radians(end[1] - start[1]) * _EARTH_RADIUS * math.cos(math.radians(start[0]))
    return np.array([north, -east, end[2] - start[2]])
