"""Points of a LiDAR's driver in ROS 2: PointCloud2, or the CustomMsg of livox_ros_driver2."""

from __future__ import annotations

import logging
import struct
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_planner.onboard.host_clock import HostClock
from aero_planner.onboard.interfaces import PointCounters, PointPacket
from aero_planner.onboard.livox import noise_mask

_log = logging.getLogger(__name__)

_WAITING_MAX = 20
"""Messages that wait for the control loop; the oldest are dropped."""
_POINTS_MAX = 1_000_000
_WORLD_FRAMES = ("world", "map", "odom", "camera_init")
"""Frames of clouds that were moved to the world already, such as FAST-LIO2's."""
_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_OFFSETS = {"offset_time": 1e-9, "t": 1e-9, "time": 1.0, "time_offset": 1.0}
"""Fields with the time since the stamp, and their unit [s]; "timestamp" is absolute."""
_CUSTOM_POINT = np.dtype(
    {
        "names": ["offset_time", "xyz", "tag"],
        "formats": ["<u4", ("<f4", 3), "u1"],
        "offsets": [0, 4, 17],
        "itemsize": 20,
    }
)
_CUSTOM_SIZE = 19  # [bytes] of the last point, which no padding follows

Points = tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.uint8]]


class RosPoints:
    """Takes the messages of a driver; implements `aero_planner.onboard.interfaces.PointSource`.

    Args:
        stamps: Maps stamps to host time.
        clock: Host time [s].
        keep_uncertain: Keep points that the sensor rates as possible, but not likely, noise.

    Attributes:
        counters: See `PointCounters`; a packet is a message.
    """

    def __init__(self, stamps: HostClock, clock: Callable[[], float], keep_uncertain: bool = True) -> None:
        self.counters = PointCounters()
        self._stamps, self._time = stamps, clock
        self._noise = noise_mask(keep_uncertain)
        self._waiting: deque[tuple[float, Callable[[Any], Points], Any]] = deque(maxlen=_WAITING_MAX)
        self._lost = 0
        self._refused: set[str] = set()

    def receive(self, message: Any) -> None:
        """Take a sensor_msgs/PointCloud2, on any thread."""
        self._put(decode_cloud, message)

    def receive_custom(self, data: bytes) -> None:
        """Take the bytes of a livox_ros_driver2/CustomMsg, on any thread."""
        self._put(decode_custom, data)

    def _put(self, decode: Callable[[Any], Points], message: Any) -> None:
        self._lost += len(self._waiting) == _WAITING_MAX
        self._waiting.append((self._time(), decode, message))

    def poll(self) -> list[PointPacket]:
        """Return the points that have arrived since the last call, oldest first."""
        packets: list[PointPacket] = []
        self.counters.lost = self._lost
        while self._waiting:
            arrival, decode, message = self._waiting.popleft()
            try:
                points, stamps, tags = decode(message)
                newest = float(stamps.max(initial=-np.inf))
                last = self._stamps.to_host(newest, arrival) if len(stamps) else arrival
                if last is None:
                    raise ValueError("its time is inconsistent")
            except (ValueError, struct.error) as error:
                self._refuse(str(error))
                continue
            kept = (tags & self._noise == 0) & points.any(axis=1) & np.isfinite(points).all(axis=1)
            self.counters.packets += 1
            self.counters.points += int(kept.sum())
            self.counters.filtered += int(len(points) - kept.sum())
            packets.append(PointPacket(points[kept], last - (newest - stamps[kept])))
        return packets

    def _refuse(self, reason: str) -> None:
        self.counters.bad += 1
        if reason not in self._refused and len(self._refused) < _WAITING_MAX:
            self._refused.add(reason)
            _log.warning("a cloud is refused: %s", reason)

    def close(self) -> None:
        """Do nothing: `ros.RosInputs` owns the subscription."""


def decode_cloud(message: Any) -> Points:
    """Return points [m], [n, 3], their stamps [s], [n], and tags, [n], of a sensor_msgs/PointCloud2.

    Raises:
        ValueError: It is malformed, in the world frame, or has no time of each point.
    """
    if message.header.frame_id.lstrip("/") in _WORLD_FRAMES:
        raise ValueError(f"it is in the frame {message.header.frame_id}; name the topic of the driver in lidar.topic")
    count, step = message.width * message.height, message.point_step
    if not 0 <= count <= _POINTS_MAX or len(message.data) != count * step:
        raise ValueError(f"{count} points of {step} bytes do not fit its {len(message.data)} bytes")
    order = ">" if message.is_bigendian else "<"
    fields = {field.name: (order + _KINDS[field.datatype], field.offset) for field in message.fields
              if field.datatype in _KINDS and field.count == 1}  # fmt: skip
    timed = next((name for name in ("timestamp", *_OFFSETS) if name in fields), None)
    if timed is None or not {"x", "y", "z"} <= fields.keys():
        raise ValueError(
            f"it has the fields {', '.join(fields)}; x, y, z and a time of each point are needed (timestamp, "
            "offset_time, t or time): set xfer_format of livox_ros_driver2 to 0 or 1"
        )
    kinds, offsets = zip(*fields.values(), strict=True)
    rows = np.frombuffer(
        message.data,
        np.dtype({"names": list(fields), "formats": list(kinds), "offsets": list(offsets), "itemsize": step}),
    )
    points = np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float32)
    stamps, stamp = rows[timed].astype(np.float64), message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
    if timed != "timestamp":
        stamps = stamp + _OFFSETS[timed] * stamps
    elif count and abs(1e-9 * stamps[0] - stamp) < abs(stamps[0] - stamp):  # Livox gives nanoseconds
        stamps = 1e-9 * stamps
    tags = rows["tag"].astype(np.uint8) if "tag" in fields else np.zeros(count, np.uint8)
    return points, stamps, tags


def decode_custom(data: bytes) -> Points:
    """Return points [m], [n, 3], their stamps [s], [n], and tags, [n], of a livox_ros_driver2/CustomMsg in CDR.

    Raises:
        ValueError: It is malformed.
        struct.error: It is too short.
    """
    if bytes(data[:2]) != b"\x00\x01":
        raise ValueError("it is not in little-endian CDR")
    body = memoryview(data)[4:]
    (length,) = struct.unpack_from("<I", body, 8)
    at = -(-(12 + length) // 8) * 8
    base, _, _, count = struct.unpack_from("<QIB3xI", body, at)
    size = count * _CUSTOM_POINT.itemsize
    at += struct.calcsize("<QIB3xI")
    if not 0 <= count <= _POINTS_MAX or len(body) < at + size - (_CUSTOM_POINT.itemsize - _CUSTOM_SIZE) * bool(count):
        raise ValueError(f"{count} points do not fit its {len(data)} bytes")
    rows = np.frombuffer(bytes(body[at : at + size]).ljust(size, b"\0"), _CUSTOM_POINT)
    return rows["xyz"].copy(), 1e-9 * base + 1e-9 * rows["offset_time"], rows["tag"].copy()
