"""Decoding of sensor_msgs/LaserScan and of the older sensor_msgs/PointCloud as clouds."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from aero_viz.input_limits import NAME_MAX, SWEEP_POINTS_MAX
from aero_viz.recordings.point_cloud2 import RawCloud
from aero_viz.recordings.ros_messages import DamagedMessage, decode_message

LASER_SCAN = "sensor_msgs/msg/LaserScan"


def read_laser_scan(message: bytes | memoryview, encoding: str) -> RawCloud:
    """Return the points of a planar scan, NaN where it has no range between its limits.

    Raises:
        DamagedMessage: the message is damaged.
    """
    scan: Any = decode_message(message, LASER_SCAN, encoding)
    ranges = np.asarray(scan.ranges, np.float64)
    angles = scan.angle_min + scan.angle_increment * np.arange(len(ranges))
    with np.errstate(invalid="ignore"):
        ranges = np.where((ranges >= scan.range_min) & (ranges <= scan.range_max) & (ranges > 0.0), ranges, np.nan)
    if not (np.isfinite(scan.angle_increment) and np.isfinite(scan.angle_min)):
        raise DamagedMessage("its angles are not finite")
    rows = np.zeros((1, len(ranges)), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("time", "<f4")])
    rows["x"], rows["y"] = ranges * np.cos(angles), ranges * np.sin(angles)
    rows["time"] = scan.time_increment * np.arange(len(ranges))
    if not scan.header.frame_id.isprintable():
        raise DamagedMessage("a name in it is damaged")
    stamp = scan.header.stamp.sec * 10**9 + scan.header.stamp.nanosec
    return RawCloud(stamp, scan.header.frame_id.lstrip("/"), rows)


def read_point_cloud(message: bytes | memoryview, encoding: str) -> RawCloud:
    """Return the points of a sensor_msgs/PointCloud, without its channels.

    Raises:
        DamagedMessage: the message is damaged.
    """
    try:
        start = 4 if encoding == "cdr" else 0  # of the content, which CDR aligns; ROS 1 has a sequence number first
        order = ">" if encoding == "cdr" and message[1] == 0 else "<"
        seconds, nanoseconds, length = struct.unpack_from(f"{order}iII", message, 4)
        end = 16 + length
        frame = bytes(message[16 : min(end, 16 + NAME_MAX)]).rstrip(b"\0").decode(errors="replace")
        at = end + -(end - start) % 4 if start else end
        (count,) = struct.unpack_from(f"{order}I", message, at)
    except (struct.error, IndexError) as error:
        raise DamagedMessage("it ends within its header") from error
    if not frame.isprintable():
        raise DamagedMessage("a name in it is damaged")
    if count > SWEEP_POINTS_MAX or at + 4 + 12 * count > len(message):
        raise DamagedMessage(f"it has {len(message)} bytes, too few for {count} points")
    dtype = np.dtype([(axis, f"{order}f4") for axis in "xyz"])
    rows = np.frombuffer(message, dtype, count, at + 4).reshape(1, -1)
    return RawCloud(seconds * 10**9 + nanoseconds, frame.lstrip("/"), rows)
