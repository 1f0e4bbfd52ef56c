"""Poses for a stream without any: LiDAR odometry of every cloud as it arrives."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

import numpy as np

from aero_planner.mailbox import Mailbox
from aero_planner.onboard.ros_definitions import ODOMETRY
from aero_planner.quaternions import quaternion_of_matrix
from aero_viz.live.stream import LiveMessage, Stream
from aero_viz.recordings.clouds import read_cloud
from aero_viz.recordings.imu import ImuSamples, unit_of
from aero_viz.recordings.imu_messages import IMU_TYPE
from aero_viz.recordings.odometry import KissIcp, RkoLio, level_of, time_in_sweep
from aero_viz.recordings.point_cloud2 import decode_points
from aero_viz.recordings.recording import PointSweep
from aero_viz.recordings.ros_messages import DamagedMessage, decode_message, encode_message, message_type
from aero_viz.recordings.transforms import IDENTITY, Transform

TOPIC = "/aero_viz/odometry"
"""Topic of the estimated poses."""
_WORLD = "odom"
_LATE = 3
"""Clouds that may wait: where the registration is slower than the sensor, the oldest are left out, and counted."""
_SAMPLES = 20_000
"""Samples of the IMU that may wait for a cloud: a minute of most."""
_IMU_DELAY = 0.2
"""Longest time for which a cloud waits for the samples of the IMU until its end [s]."""
_Sample = tuple[int, tuple[float, ...], tuple[float, ...]]
"""Stamp [ns], specific force and angular velocity of a sample of the IMU."""


class OnlineOdometry:
    """Registers the clouds of a topic on a thread of its own and adds their poses to the stream.

    Args:
        stream: the stream.
        method: "kiss-icp" or "rko-lio", which needs an IMU and a time per point.
        points: topic of the clouds.
        imu: topic of the IMU; None is the first one. The sensor and its IMU are taken for one.
        mount: pose of both in the body's frame; the poses are those of the body.

    Attributes:
        missing: what the registration waits for, as a sentence; empty if for nothing.

    Raises:
        UserError: the library is not installed.
    """

    def __init__(
        self, stream: Stream, method: str, *, points: str, imu: str | None = None, mount: Transform = IDENTITY
    ) -> None:
        self._stream, self._method, self._mount = stream, method, mount
        self._points, self._imu = points, imu
        self.missing = ""
        self._register: KissIcp | RkoLio | None = None
        if method == "kiss-icp":
            self._register = KissIcp(np.eye(4))
        self._samples: deque[_Sample] = deque(maxlen=_SAMPLES)
        self._newest_sample = 0
        self._force_unit = 1.0
        self._last = -np.inf
        self._start: int | None = None
        self._clouds: Mailbox[LiveMessage] = Mailbox(self._take, capacity=_LATE, name="aero-viz-odometry")
        # Of the clouds that have arrived, only the newest one: the poses begin now.
        newest: deque[LiveMessage] = deque(maxlen=1)
        self._put: Callable[[LiveMessage], object] = newest.append
        self._end = stream.listen(self._listen, from_kept=True)
        self._put = self._clouds.put
        for message in newest:
            self._put(message)

    @property
    def dropped(self) -> int:
        """Number of clouds that were left out because the registration is too slow."""
        return self._clouds.dropped

    def _listen(self, message: LiveMessage) -> None:
        if message.topic == self._points:
            self._put(message)
        elif message.type == IMU_TYPE and self._method == "rko-lio":
            self._imu = self._imu or message.topic
            if message.topic == self._imu:
                self._add_imu(message)

    def _add_imu(self, message: LiveMessage) -> None:
        try:
            sample = decode_message(message.data, IMU_TYPE, "cdr")
        except DamagedMessage as error:
            self._stream.topics[message.topic].refuse(str(error))
            return
        force, rate, stamp = sample.linear_acceleration, sample.angular_velocity, sample.header.stamp
        values = (force.x, force.y, force.z, rate.x, rate.y, rate.z)
        at = stamp.sec * 10**9 + stamp.nanosec or message.time
        if not np.isfinite(values).all() or at <= self._newest_sample:
            self._stream.topics[message.topic].refuse("it is not finite, or not later than the one before")
            return
        self._newest_sample = at
        self._samples.append((at, values[:3], values[3:]))

    def _take(self, message: LiveMessage) -> None:
        try:
            cloud = read_cloud(message.data, message.type, "cdr")
        except DamagedMessage:
            return  # counted where the cloud is placed
        decoded = decode_points(cloud)
        stamp = cloud.stamp or message.time
        if not len(decoded.points):
            return
        self._start = self._start or stamp
        points = self._mount.move(decoded.points)
        sweep = PointSweep((stamp - self._start) * 1e-9, points, decoded.times, decoded.dropped)
        register = self._register or self._make_rko(sweep, stamp)
        if register is None:
            return
        if isinstance(register, RkoLio):
            if sweep.point_times is None:  # a single cloud whose times are damaged
                return
            self._wait_for_samples(self._start + round(1e9 * time_in_sweep(sweep, 1.0)))
            register.add_imu(self._as_samples([self._samples.popleft() for _ in range(len(self._samples))]))
        matrix = register(sweep)
        posed = time_in_sweep(sweep, register.posed_at)
        if matrix is None or not np.isfinite(matrix).all() or posed <= self._last:
            return
        self._last = posed
        self._stream.add(TOPIC, ODOMETRY, _encode(matrix, self._start + round(1e9 * posed), cloud.frame))

    def _wait_for_samples(self, end: int) -> None:
        deadline = time.monotonic() + _IMU_DELAY
        while self._newest_sample < end and time.monotonic() < deadline:
            time.sleep(0.002)

    def _make_rko(self, sweep: PointSweep, stamp: int) -> RkoLio | None:
        """Return the registration, None while there is no IMU or no time per point."""
        assert self._start is not None
        if sweep.point_times is None:
            self.missing = f"rko-lio needs a time for each point, which {self._points} does not give: take kiss-icp."
            return None
        if not self._samples:
            self.missing = f"rko-lio needs an IMU, and nothing arrives from {self._imu or 'any'}: take kiss-icp."
            return None
        self.missing = ""
        samples = list(self._samples)
        self._force_unit = unit_of(np.array([force for _, force, _ in samples]))
        level = level_of(self._as_samples(samples), self._mount, stamp)
        self._register = register = RkoLio(None, self._mount, level, self._start)
        return register

    def _as_samples(self, samples: list[_Sample]) -> ImuSamples:
        times, forces, rates = zip(*samples, strict=True) if samples else ((), (), ())
        vectors = (np.array(values, np.float64).reshape(-1, 3) for values in (forces, rates))
        return ImuSamples("", "", np.array(times, np.int64), self._force_unit * next(vectors), next(vectors))

    def close(self) -> None:
        """Stop."""
        self._end()
        self._clouds.close()


def _encode(matrix: np.ndarray, stamp: int, body: str) -> bytes:
    """Return a pose [4, 4] as Odometry; its velocity is not set."""
    w, x, y, z = (float(value) for value in quaternion_of_matrix(matrix[:3, :3]))
    vector, none = message_type("geometry_msgs/msg/Vector3"), np.zeros(36)
    zero = vector(0.0, 0.0, 0.0)
    at = message_type("builtin_interfaces/msg/Time")(sec=stamp // 10**9, nanosec=stamp % 10**9)
    pose = message_type("geometry_msgs/msg/Pose")(
        message_type("geometry_msgs/msg/Point")(*(float(value) for value in matrix[:3, 3])),
        message_type("geometry_msgs/msg/Quaternion")(x, y, z, w),
    )
    message = message_type(ODOMETRY)(
        header=message_type("std_msgs/msg/Header")(stamp=at, frame_id=_WORLD),
        child_frame_id=body,
        pose=message_type("geometry_msgs/msg/PoseWithCovariance")(pose, none),
        twist=message_type("geometry_msgs/msg/TwistWithCovariance")(
            message_type("geometry_msgs/msg/Twist")(zero, zero), none
        ),
    )
    return encode_message(message, ODOMETRY)
