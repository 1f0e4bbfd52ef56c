"""Decoding of sensor_msgs/LaserScan, and of Foxglove's own PointCloud (Protobuf), as clouds."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any

import numpy as np

from aero_viz.recordings.point_cloud2 import RawCloud
from aero_viz.recordings.ros_messages import DamagedMessage, decode_message

LASER_SCAN = "sensor_msgs/msg/LaserScan"
FOXGLOVE_CLOUD = "foxglove.PointCloud"

_NUMERIC = {1: "u1", 2: "i1", 3: "<u2", 4: "<i2", 5: "<u4", 6: "<i4", 7: "<f4", 8: "<f8"}
"""NumPy formats of foxglove.PackedElementField.NumericType."""


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


def read_foxglove(message: bytes | memoryview, encoding: str) -> RawCloud:
    """Return the cloud in a foxglove.PointCloud encoded by Protobuf. Its `pose` is ignored.

    Raises:
        DamagedMessage: the message is damaged, of another encoding, or lacks one of x, y, z.
    """
    if encoding != "protobuf":
        raise DamagedMessage(f"its encoding is {encoding or 'not given'}, not protobuf")
    try:
        return _read_foxglove(memoryview(message))
    except (struct.error, IndexError, UnicodeDecodeError, ValueError) as error:
        if isinstance(error, DamagedMessage):
            raise
        raise DamagedMessage("its bytes are damaged") from error


def _read_foxglove(message: memoryview) -> RawCloud:
    stamp, frame, step, data = 0, "", 0, memoryview(b"")
    fields: dict[str, tuple[str, int]] = {}
    for number, value in _fields(message):
        if number == 1:
            parts: dict[int, Any] = dict(_fields(value))
            stamp = parts.get(1, 0) * 10**9 + parts.get(2, 0)
        elif number == 2:
            frame = bytes(value).decode()
        elif number == 4:
            step = value
        elif number == 5:
            field: dict[int, Any] = dict(_fields(value))
            fields[bytes(field.get(1, b"")).decode()] = (_NUMERIC.get(field.get(3, 0), ""), field.get(2, 0))
        elif number == 6:
            data = value
    missing = [axis for axis in "xyz" if not fields.get(axis, ("", 0))[0].endswith(("f4", "f8"))]
    if missing:
        present = ", ".join(fields) or "no fields"
        raise DamagedMessage(f"it lacks {', '.join(missing)} as floating-point fields and has {present}")
    chosen = {axis: fields[axis] for axis in "xyz"}
    if not step or any(offset + int(code[-1]) > step for code, offset in chosen.values()):
        raise DamagedMessage(f"a field lies outside its point_stride of {step} bytes")
    if not frame.isprintable() or not 0 <= stamp < 1 << 63:
        raise DamagedMessage("its header is damaged")
    names, formats = list(chosen), [code for code, _ in chosen.values()]
    dtype = np.dtype(
        {"names": names, "formats": formats, "offsets": [offset for _, offset in chosen.values()], "itemsize": step}
    )
    return RawCloud(stamp, frame.lstrip("/"), np.ndarray((1, len(data) // step), dtype, data))


def _fields(message: memoryview) -> Iterator[tuple[int, Any]]:
    """Yield number and value of the fields of a Protobuf message: integers, and views of what has a length."""
    position = 0
    while position < len(message):
        key, position = _varint(message, position)
        number, kind = key >> 3, key & 7
        if number == 0:  # the padding behind the head of a message whose points were not read
            return
        if kind == 0:
            value, position = _varint(message, position)
        elif kind in (1, 5):
            size = 8 if kind == 1 else 4
            value = int.from_bytes(message[position : position + size], "little")
            position += size
        elif kind == 2:
            length, position = _varint(message, position)
            if position + length > len(message):
                raise DamagedMessage("it ends within a field")
            value = message[position : position + length]
            position += length
        else:
            raise DamagedMessage("its bytes are damaged")
        yield number, value


def _varint(message: memoryview, position: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 64, 7):
        byte = message[position]
        position += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, position
    raise DamagedMessage("its bytes are damaged")
