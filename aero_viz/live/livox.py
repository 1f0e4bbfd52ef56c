"""A Livox Mid-360 on the desk as a stream: its packets, by the parser of the node, as clouds of a tenth of a second."""

from __future__ import annotations

import contextlib
import socket
import threading
import time

import numpy as np
from numpy.typing import NDArray

from aero_planner.onboard.host_clock import HostClock
from aero_planner.onboard.livox import LivoxSource, parse_imu
from aero_viz.errors import UserError
from aero_viz.live.stream import Stream
from aero_viz.recordings.imu_messages import GRAVITY, IMU_TYPE, encode_imu
from aero_viz.recordings.point_cloud2 import POINT_CLOUD2, encode_point_cloud2

POINTS_TOPIC, IMU_TOPIC = "/livox/lidar", "/livox/imu"
"""Topics of the stream, named as by livox_ros_driver2."""
FRAME = "livox_frame"
_SWEEP = 0.1
"""A Livox does not rotate: the points of this period form a sweep [s]."""
_POLL = 0.005
"""Time between two looks at the sockets [s]."""
_DATAGRAM = 2048
_PORT, _PORT_MAX, _IMU_AFTER = 56301, 65535, 100
"""Port of this computer to which a sensor sends points unless it is configured otherwise, the largest one, and how much
higher that for the IMU is."""


class LivoxFeed:
    """Receives the packets of one sensor on a thread of its own.

    Args:
        stream: takes clouds, and samples of the sensor's IMU.
        sensor: address of the sensor, and behind a colon the port of this computer to which it sends points, if that is
            not 56301; 0 takes free ones. None takes any sensor. The port for its IMU is higher by 100.

    Raises:
        UserError: there is no such port, it is in use, by another driver for example, or the sensor's name has no
            address.
    """

    def __init__(self, stream: Stream, sensor: str | None) -> None:
        self._stream = stream
        self._stamps = HostClock()  # of points and IMU, so that they fit each other
        host, _, number = (sensor or "").partition(":")
        number = number or str(_PORT)
        if not (number.isdecimal() and int(number) <= _PORT_MAX - _IMU_AFTER):
            raise UserError(f"--livox takes an address, and a port up to {_PORT_MAX - _IMU_AFTER}, not {sensor}.")
        port = int(number)
        try:
            self._address = None if sensor is None else socket.gethostbyname(host)
        except OSError as error:
            raise UserError(f"The Livox {sensor} has no address: {error.strerror}; give its number.") from error
        try:
            self._source = LivoxSource(port, sensor=self._address, clock=self._now, stamps=self._stamps)
        except OSError as error:
            raise UserError(
                f"The packets of the Livox at {sensor} cannot be received on port {port}: {error.strerror or error}; "
                "end the driver that holds the port, or read its topics instead: aero-viz live."
            ) from error
        self._imu = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._imu.setblocking(False)
        with contextlib.suppress(OSError):  # without the IMU, the points are still of use
            self._imu.bind(("0.0.0.0", port and port + _IMU_AFTER))
        self._points: list[tuple[NDArray[np.float32], NDArray[np.float64]]] = []
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="aero-viz-livox", daemon=True)
        self._thread.start()

    @property
    def ports(self) -> tuple[int, int]:
        """UDP ports of the points and of the IMU."""
        return self._source.port, self._imu.getsockname()[1]

    def _now(self) -> float:
        return 1e-9 * self._stream.clock.now()

    def _run(self) -> None:
        while not self._closed.wait(_POLL):
            for packet in self._source.poll():
                if len(packet.points):
                    self._points.append((packet.points, packet.times))
            self._send_imu()  # first: odometry needs the samples of a sweep with it
            self._send_sweep()

    def _send_sweep(self) -> None:
        """Add a cloud once the points of a period have arrived."""
        if not self._points or float(self._points[-1][1][-1]) - float(self._points[0][1][0]) < _SWEEP:
            return
        points, times = (np.concatenate(parts) for parts in zip(*self._points, strict=True))
        self._points = []
        order = np.argsort(times, kind="stable")
        stamp = round(1e9 * float(times[order[0]]))
        after = np.round(1e9 * (times[order] - times[order[0]])).astype(np.uint32)
        self._stream.add(POINTS_TOPIC, POINT_CLOUD2, encode_point_cloud2(points[order], stamp, FRAME, times=after))

    def _send_imu(self) -> None:
        while True:
            try:
                data, address = self._imu.recvfrom(_DATAGRAM)
            except OSError:
                return
            sample = parse_imu(data)
            if sample is None or self._address not in (None, address[0]):
                continue
            stamp = self._stamps.to_host(1e-9 * sample[0], self._now())
            if stamp is not None:
                values = sample[1]
                forces = [GRAVITY * value for value in values[3:]]
                self._stream.add(IMU_TOPIC, IMU_TYPE, encode_imu(round(1e9 * stamp), FRAME, values[:3], forces))

    def wait(self, timeout: float) -> bool:
        """Return True once a cloud has arrived, False after `timeout` [s]."""
        deadline = time.monotonic() + timeout
        while POINTS_TOPIC not in self._stream.topics:
            if time.monotonic() > deadline:
                return False
            time.sleep(_POLL)
        return True

    def close(self) -> None:
        """Close the sockets."""
        self._closed.set()
        self._thread.join()
        self._source.close()
        self._imu.close()
