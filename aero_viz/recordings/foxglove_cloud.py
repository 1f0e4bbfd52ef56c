"""Decoding of Foxglove's own PointCloud, in Protobuf, JSON, ROS 1 and ROS 2."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from aero_planner.quaternions import rotation_matrix
from aero_viz.input_limits import NAME_MAX, SWEEP_POINTS_MAX
from aero_viz.point_times import time_field
from aero_viz.recordings.point_cloud2 import RawCloud
from aero_viz.recordings.ros_messages import ENCODINGS, DamagedMessage, decode_message

FOXGLOVE_CLOUD, FOXGLOVE_ROS_CLOUD = "foxglove.PointCloud", "foxglove_msgs/msg/PointCloud"

_NUMERIC = {1: "u1", 2: "i1", 3: "<u2", 4: "<i2", 5: "<u4", 6: "<i4", 7: "<f4", 8: "<f8"}
"""NumPy formats of foxglove.PackedElementField.NumericType."""


class _Content(NamedTuple):
    """The fields of a message."""

    stamp: int
    """[ns]."""
    frame: str
    pose: Sequence[float]
    """Position [m] and quaternion (x, y, z, w) of the cloud in its frame [7]."""
    step: int
    """Bytes from one point to the next."""
    fields: dict[str, tuple[str, int]]
    """Format and offset of each number of a point."""
    data: bytes | memoryview


def read_foxglove(message: bytes | memoryview, encoding: str) -> RawCloud:
    """Return the cloud in a PointCloud of Foxglove, moved by its `pose` to its frame.

    Raises:
        DamagedMessage: the message is damaged, of another encoding, or lacks one of x, y, z.
    """
    try:
        if encoding == "protobuf":
            return _cloud(_from_protobuf(memoryview(message)))
        if encoding == "json":
            return _cloud(_from_json(bytes(message)))
        if encoding in ENCODINGS:
            return _cloud(_from_ros(decode_message(message, FOXGLOVE_ROS_CLOUD, encoding)))
    except DamagedMessage:
        raise
    except Exception as error:  # wrong types in JSON fail in many ways
        raise DamagedMessage("its bytes are damaged") from error
    raise DamagedMessage(f"its encoding is {encoding or 'not given'}, not protobuf, json, CDR or ROS 1")


def _cloud(content: _Content) -> RawCloud:
    fields, step = content.fields, content.step
    missing = [axis for axis in "xyz" if not fields.get(axis, ("", 0))[0].endswith(("f4", "f8"))]
    if missing:
        present = ", ".join(fields)[:NAME_MAX] or "no fields"
        raise DamagedMessage(f"it lacks {', '.join(missing)} as floating-point fields and has {present}")
    chosen = {axis: fields[axis] for axis in "xyz"}
    if time := time_field({name: code for name, (code, _) in fields.items()}):
        chosen["time"] = fields[time]
    if not step or any(offset + int(code[-1]) > step for code, offset in chosen.values()):
        raise DamagedMessage(f"a field lies outside its point_stride of {step} bytes")
    if len(content.frame) > NAME_MAX or not content.frame.isprintable() or not 0 <= content.stamp < 1 << 63:
        raise DamagedMessage("its header is damaged")
    count = len(content.data) // step
    if count > SWEEP_POINTS_MAX:
        raise DamagedMessage(f"it has {count} points, more than {SWEEP_POINTS_MAX}")
    formats, offsets = zip(*chosen.values(), strict=True)
    dtype = np.dtype({"names": list(chosen), "formats": formats, "offsets": offsets, "itemsize": step})
    rows = np.ndarray((1, count), dtype, content.data)
    pose = np.array(content.pose, np.float64)
    notice = "" if pose[3:].any() or not pose.any() else "the orientation of their pose is unset: none is assumed"
    return RawCloud(content.stamp, content.frame.lstrip("/"), _moved(rows, pose), notice)


def _moved(rows: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Return the rows with x, y and z moved by a pose, position and quaternion (x, y, z, w), which may be unset."""
    if not np.isfinite(pose).all():
        raise DamagedMessage("its pose is not finite")
    if not pose[:6].any():  # unset, or the identity
        return rows
    length = np.linalg.norm(pose[3:])
    quaternion = pose[[6, 3, 4, 5]] / length if length else np.array([1.0, 0.0, 0.0, 0.0])
    points = np.stack([rows[axis].reshape(-1) for axis in "xyz"], axis=1) @ rotation_matrix(quaternion).T + pose[:3]
    names = rows.dtype.names or ()
    moved = np.empty(rows.shape, [(name, "<f4" if name in "xyz" else rows.dtype[name]) for name in names])
    for name in names:
        moved[name] = points[:, "xyz".index(name)] if name in "xyz" else rows[name]
    return moved


def _from_ros(cloud: Any) -> _Content:
    position, turn = cloud.pose.position, cloud.pose.orientation
    pose = (position.x, position.y, position.z, turn.x, turn.y, turn.z, turn.w)
    fields = {field.name: (_NUMERIC.get(field.type, ""), field.offset) for field in cloud.fields}
    stamp = cloud.timestamp.sec * 10**9 + cloud.timestamp.nanosec
    return _Content(stamp, cloud.frame_id, pose, cloud.point_stride, fields, memoryview(cloud.data))


def _from_json(message: bytes) -> _Content:
    cloud = json.loads(message)
    time, pose = cloud["timestamp"], cloud.get("pose") or {}
    position, turn = pose.get("position") or {}, pose.get("orientation") or {}
    fields = {str(field["name"]): (_NUMERIC.get(field["type"], ""), int(field["offset"])) for field in cloud["fields"]}
    return _Content(
        int(time["sec"]) * 10**9 + int(time["nsec"]),
        str(cloud["frame_id"]),
        [position.get(axis, 0.0) for axis in "xyz"] + [turn.get(axis, 0.0) for axis in "xyzw"],
        int(cloud["point_stride"]),
        fields,
        base64.b64decode(cloud["data"]),
    )


def _from_protobuf(message: memoryview) -> _Content:
    stamp, frame, step, data = 0, "", 0, memoryview(b"")
    pose = [0.0] * 7
    fields: dict[str, tuple[str, int]] = {}
    for number, value in _fields(message):
        if number == 1:
            parts: dict[int, Any] = dict(_fields(value))
            stamp = parts.get(1, 0) * 10**9 + parts.get(2, 0)
        elif number == 2:
            frame = bytes(value).decode()
        elif number == 3:
            for part, numbers in _fields(value):  # position and orientation
                for axis, bits in _fields(numbers):
                    pose[3 * (part - 1) + axis - 1] = struct.unpack("<d", bits.to_bytes(8, "little"))[0]
        elif number == 4:
            step = value
        elif number == 5:
            field: dict[int, Any] = dict(_fields(value))
            fields[bytes(field.get(1, b"")).decode()] = (_NUMERIC.get(field.get(3, 0), ""), field.get(2, 0))
        elif number == 6:
            data = value
    return _Content(stamp, frame, pose, step, fields, data)


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
