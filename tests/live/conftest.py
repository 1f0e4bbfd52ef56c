"""Streams without ROS: a body that flies along a corridor, message by message."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from aero_planner.onboard.ros_messages import pose_messages
from aero_planner.plan import VehicleState
from aero_planner.quaternions import conjugate, rotate
from aero_viz.live.session import StreamSession
from aero_viz.live.setup import Wanted, find_setup
from aero_viz.live.source import StreamSource
from aero_viz.live.stream import Stream
from aero_viz.recordings.point_cloud2 import POINT_CLOUD2, encode_point_cloud2

ODOMETRY = "nav_msgs/msg/Odometry"
SPEED = 1.0
STEP = 20_000_000
"""Time between two poses [ns]."""


def walls(count: int = 1500) -> NDArray[np.float32]:
    """Return points of a corridor along x [m], world frame."""
    random = np.random.default_rng(0)
    points = random.uniform((-15.0, -3.0, 0.0), (15.0, 3.0, 4.0), (count, 3))
    points[::2, 1] = np.where(points[::2, 1] > 0.0, 3.0, -3.0)
    points[1::2, 2] = 0.0
    return points.astype(np.float32)


@dataclasses.dataclass
class Corridor:
    """Feeds a stream with poses at 50 Hz and clouds at 10 Hz, as fast as it is asked to."""

    stream: Stream
    now: int
    """Arrival of the next messages [ns]."""
    offset: int = 0
    """Difference of the stamps from the arrivals [ns]."""
    start: int = 0
    yaw: float = 0.0
    """Heading of the body [rad]; it flies along x."""
    twist_in_world: bool = False
    """True writes the velocity in the world frame, which is wrong."""
    tf: bool = False
    """True writes the poses as transforms."""

    @property
    def quaternion(self) -> NDArray[np.float64]:
        return np.array([np.cos(self.yaw / 2), 0.0, 0.0, np.sin(self.yaw / 2)])

    def place(self, time: int) -> NDArray[np.float64]:
        return np.array([SPEED * 1e-9 * (time - self.start), 0.0, 1.5])

    def pose(self) -> None:
        velocity = np.array([SPEED, 0.0, 0.0])
        if self.twist_in_world:
            velocity = rotate(self.quaternion, velocity)
        state = VehicleState(self.place(self.now), velocity, self.quaternion)
        odometry, transform = pose_messages(state, self.now + self.offset)
        message, topic = (transform, "/tf") if self.tf else (odometry, "/odometry")
        self.stream.add(topic, message.kind, message.data, time=self.now)

    def cloud(
        self, points: NDArray[np.float32] | None = None, *, ahead: int = 0, topic: str = "/points", frame: str = "body"
    ) -> None:
        """Add a cloud; its stamp is `ahead` [ns] of what it should be."""
        seen = self.seen(walls()) if points is None else points
        data = encode_point_cloud2(seen, self.now + self.offset + ahead, frame)
        self.stream.add(topic, POINT_CLOUD2, data, time=self.now)

    def seen(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return points of the world frame in that of the sensor."""
        return rotate(conjugate(self.quaternion), points - self.place(self.now)).astype(np.float32)

    def fly(self, seconds: float) -> None:
        """Add what arrives within a time [s]."""
        for step in range(round(seconds * 1e9 / STEP)):
            self.pose()
            if step % 5 == 0:
                self.cloud()
            self.now += STEP


@pytest.fixture
def corridor() -> Corridor:
    """A corridor from which two seconds have arrived just now."""
    stream = Stream("corridor")
    start = stream.clock.now() - 2_000_000_000
    made = Corridor(stream, start, start=start)
    made.fly(2.0)
    return made


Open = Callable[..., StreamSession]


@pytest.fixture
def open_session(corridor: Corridor) -> Iterator[Open]:
    """Return a session of the corridor, with arguments of `StreamSource`."""
    sessions: list[StreamSession] = []

    def make(**options: object) -> StreamSession:
        setup = find_setup(corridor.stream, Wanted())
        sessions.append(StreamSession(StreamSource(corridor.stream, setup, **options)))  # type: ignore[arg-type]
        return sessions[-1]

    yield make
    for session in sessions:
        session.close()
