"""Messages of a LiDAR's driver and of FAST-LIO2, and a simulated drone that is measured by these alone."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from aero_planner.onboard.host_clock import HostClock
from aero_planner.onboard.interfaces import PointPacket
from aero_planner.onboard.odometry import RosOdometry
from aero_planner.onboard.ros_points import RosPoints
from aero_planner.onboard.settings import StateSettings
from tests.planner.onboard.simulated import SimulatedLidar, SimulatedLink

AHEAD = 1000.0
"""Time by which the clock of ROS is ahead of the host's [s]."""
LEVEL = (np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
KINDS = {"f4": 7, "f8": 8, "u4": 6, "u1": 2}


def stamp_of(seconds: float) -> Any:
    """A builtin_interfaces/Time."""
    return SimpleNamespace(sec=int(seconds), nanosec=round(1e9 * (seconds % 1.0)))


def odometry_message(
    time: float, position: Any, attitude: Any = LEVEL[1], linear: Any = (0, 0, 0), variance: float = 0.0
) -> Any:
    """A nav_msgs/Odometry with a stamp of another clock."""
    x, y, z, (w, a, b, c) = *position, attitude
    covariance = np.diag([variance, 0.5 * variance, 0.0, 9.0, 9.0, 9.0]).ravel()
    pose = SimpleNamespace(position=SimpleNamespace(x=x, y=y, z=z), orientation=SimpleNamespace(w=w, x=a, y=b, z=c))
    twist = SimpleNamespace(linear=SimpleNamespace(x=linear[0], y=linear[1], z=linear[2]))
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp_of(time + AHEAD)), pose=SimpleNamespace(pose=pose, covariance=covariance),
        twist=SimpleNamespace(twist=twist, covariance=covariance),
    )  # fmt: skip


def cloud_message(
    points: Any, *, stamp: float = 100.0, frame: str = "livox_frame", order: str = "<", **columns: tuple[str, Any]
) -> Any:
    """A sensor_msgs/PointCloud2 with points and further columns, each a type and its values."""
    fields = {name: ("f4", points[:, axis]) for axis, name in enumerate("xyz")} | columns
    rows = np.zeros(len(points), [(name, order + kind) for name, (kind, _) in fields.items()])
    for name, (_, values) in fields.items():
        rows[name] = values
    described = [
        SimpleNamespace(name=name, offset=rows.dtype.fields[name][1], datatype=KINDS[kind], count=1)  # type: ignore[index]
        for name, (kind, _) in fields.items()
    ]
    header = SimpleNamespace(stamp=stamp_of(stamp), frame_id=frame)
    return SimpleNamespace(
        header=header, fields=described, width=len(rows), height=1, point_step=rows.itemsize, data=rows.tobytes(),
        is_bigendian=order == ">",
    )  # fmt: skip


class RosLink(SimulatedLink):
    """An autopilot beside a FAST-LIO2 that gives 20 poses a second, each 30 ms after it was measured."""

    period, delay = 0.05, 0.03

    def __init__(self, simulation: Any) -> None:
        super().__init__(simulation)
        self.stamps = HostClock()
        self.odometry = RosOdometry(StateSettings(), LEVEL, self.stamps, lambda: simulation.now)
        self.lost = np.zeros(3)
        """What the odometry is wrong by [m], shape [3]."""
        self.variance = 1e-4
        self.odometry_alive = True
        self._due = -np.inf
        self._computed: list[tuple[float, Any]] = []

    def poll(self) -> None:
        super().poll()
        motion, now = self._simulation.motion, self._simulation.now
        if now >= self._due and self.odometry_alive:
            self._due = now + self.period
            place = motion.position + self.lost
            given = odometry_message(motion.time, place, motion.quaternion, variance=self.variance)
            self._computed.append((now + self.delay, given))
        while self._computed and self._computed[0][0] <= now:
            self.odometry.receive(self._computed.pop(0)[1])
        self.state = self.odometry.place(self.state)


class RosLidar(SimulatedLidar):
    """A LiDAR whose driver gives ten clouds a second."""

    def __init__(self, simulation: Any, world: Any) -> None:
        super().__init__(simulation, world)
        self.driver = RosPoints(simulation.link.stamps, lambda: simulation.now)
        self._parts: list[PointPacket] = []

    def poll(self) -> list[PointPacket]:
        self._parts += super().poll()
        if self._parts and self._simulation.now >= self._parts[0].times[0] + 0.1:
            points, times = (
                np.concatenate([getattr(part, name) for part in self._parts]) for name in ("points", "times")
            )
            first = float(times[0]) + AHEAD
            self.driver.receive(cloud_message(points, stamp=first, timestamp=("f8", 1e9 * (times + AHEAD))))
            self._parts = []
        return self.driver.poll()
