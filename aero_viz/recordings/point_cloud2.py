"""Decoding of sensor_msgs/PointCloud2 into points in metres and a time per point."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_viz.input_limits import NAME_MAX, SWEEP_POINTS_MAX
from aero_viz.point_times import point_times, time_field, time_unit
from aero_viz.recordings.ros_messages import DamagedMessage, decode_message, encode_message, message_type

if TYPE_CHECKING:
    from rosbags.typesys.stores.ros2_humble import sensor_msgs__msg__PointCloud2 as PointCloud2

POINT_CLOUD2 = "sensor_msgs/msg/PointCloud2"

_MAX_RANGE = 1e4
"""No LiDAR measures farther [m]. A larger coordinate is damaged and would overflow later."""

_FORMATS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8", 9: "i8", 10: "u8"}
"""NumPy formats of sensor_msgs/PointField.datatype."""
_COORDINATE_FORMATS = ("f4", "f8")


class RawCloud(NamedTuple):
    """A cloud as it is in its message."""

    stamp: int
    """Time in the header [ns], 0 where the driver set none."""
    frame: str
    """Frame of the coordinates."""
    rows: NDArray[np.void]
    """View of the message as structured array [height, width] with the fields x, y, z and, if recorded, time."""
    notice: str = ""
    """Assumption about such clouds, for the user."""
    sensor: str = ""
    """Name of the sensor, where the message has one besides its frame."""


class DecodedPoints(NamedTuple):
    """The valid points of a cloud."""

    points: NDArray[np.float32]
    """[P, 3] [m], in the frame of the cloud."""
    times: NDArray[np.float32] | None
    """Time of each point after the stamp [P] [s], None if it was not recorded."""
    dropped: int
    """Number of invalid points."""


def read_point_cloud2(message: bytes | memoryview, encoding: str) -> RawCloud:
    """Return the cloud in a sensor_msgs/PointCloud2 message.

    Raises:
        DamagedMessage: the message is damaged, contradicts itself, or lacks one of x, y, z.
    """
    cloud: PointCloud2 = decode_message(message, POINT_CLOUD2, encoding)
    names = ", ".join(field.name for field in cloud.fields[:64])[:NAME_MAX]
    if len(cloud.header.frame_id) > NAME_MAX:
        raise DamagedMessage("the name of its frame is too long")
    if not (names + cloud.header.frame_id).isprintable():
        raise DamagedMessage("a name in it is damaged")
    # A field may have several elements. Only the first one matters here.
    fields = {field.name: (_FORMATS.get(field.datatype, ""), field.offset) for field in cloud.fields}
    missing = [axis for axis in "xyz" if axis not in fields or fields[axis][0] not in _COORDINATE_FORMATS]
    if missing:
        raise DamagedMessage(f"it lacks {', '.join(missing)} as floating-point fields and has {names or 'no fields'}")
    chosen = {axis: fields[axis] for axis in "xyz"}
    if time := time_field({name: code for name, (code, _) in fields.items()}):
        chosen["time"] = fields[time]
    if any(offset + int(code[-1]) > cloud.point_step for code, offset in chosen.values()):
        raise DamagedMessage(f"a field lies outside its point_step of {cloud.point_step} bytes")
    order = ">" if cloud.is_bigendian else "<"
    dtype = np.dtype(
        {
            "names": list(chosen),
            "formats": [order + code for code, _ in chosen.values()],
            "offsets": [offset for _, offset in chosen.values()],
            "itemsize": cloud.point_step,
        }
    )
    height, width, row_step = cloud.height, cloud.width, checked_row_step(cloud)
    if height * width > SWEEP_POINTS_MAX:
        raise DamagedMessage(f"it has {height * width} points, more than {SWEEP_POINTS_MAX}")
    rows = np.ndarray((height, width), dtype, cloud.data, 0, (row_step, cloud.point_step))
    stamp = cloud.header.stamp.sec * 10**9 + cloud.header.stamp.nanosec
    return RawCloud(stamp, cloud.header.frame_id.lstrip("/"), rows)


def checked_row_step(cloud: Any) -> int:
    """Return the length of a row of a PointCloud2 [bytes].

    Raises:
        DamagedMessage: the points do not fit into the data.
    """
    height, width, row_size = cloud.height, cloud.width, cloud.width * cloud.point_step
    # Several drivers leave row_step unset, or wrong, in clouds of one row, where it has no meaning.
    row_step = cloud.row_step if height > 1 and cloud.row_step else row_size
    if row_step < row_size or (height and (height - 1) * row_step + row_size > len(cloud.data)):
        raise DamagedMessage(
            f"{height} x {width} points of {cloud.point_step} bytes do not fit into {len(cloud.data)} bytes"
        )
    return row_step


def decode_points(
    cloud: RawCloud, *, unit: float | None = None, origin: NDArray[np.float64] | None = None
) -> DecodedPoints:
    """Return the valid points of a cloud and their times.

    Args:
        cloud: the cloud.
        unit: unit of the times [s]; None finds it from the times.
        origin: position of the sensor [3] [m] in the frame of a cloud that was moved to the world. It is subtracted,
            because map coordinates exceed any range, and float32 does not resolve them.
    """
    rows = cloud.rows
    if not rows.size:
        return DecodedPoints(np.empty((0, 3), np.float32), None, 0)
    with np.errstate(over="ignore", invalid="ignore"):
        points = np.stack([rows[axis].reshape(-1) for axis in "xyz"], axis=1)
        if origin is not None:
            points = np.where(points.any(axis=1, keepdims=True), points - origin, np.nan)  # zero is "no return"
        points = points.astype(np.float32, copy=False)
        valid = valid_points(points)
    values = rows["time"].reshape(-1) if "time" in (rows.dtype.names or ()) else None
    count = len(points)
    if not valid.all():  # invalid points often have no time, either
        kept = np.flatnonzero(valid)
        points, values = points.take(kept, axis=0), None if values is None else values[kept]
    times = None if values is None or not len(points) else point_times(values, cloud.stamp, unit)
    return DecodedPoints(np.ascontiguousarray(points), times, count - len(points))


def common_time_unit(clouds: Iterable[RawCloud], period: float | None = None) -> float | None:
    """Return the unit of the times of points [s] that fits most points of some clouds of a topic, None if none fits.

    Args:
        clouds: some clouds of the topic.
        period: time from one of its clouds to the next [s]; None where it is not known.
    """
    votes: dict[float, int] = {}
    for cloud in clouds:
        rows = cloud.rows.reshape(-1)
        if "time" not in (rows.dtype.names or ()):
            break
        with np.errstate(over="ignore", invalid="ignore"):
            valid = valid_points(np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float32))
        if unit := time_unit(rows["time"][valid], period):
            votes[unit] = votes.get(unit, 0) + int(valid.sum())
    return max(votes, key=lambda unit: votes[unit]) if votes else None


def valid_points(points: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return which of the points [P, 3] are valid [P].

    Points are invalid if they are not finite, lie beyond the range of any LiDAR, or are exactly zero, which is how
    spinning LiDARs report that nothing returned.
    """
    # NaN compares false, so the largest coordinate answers all three questions. A maximum along the axis of three
    # takes twenty times as long.
    largest = np.abs(points[:, 0])
    for axis in (1, 2):
        np.maximum(largest, np.abs(points[:, axis]), out=largest)
    return (largest > 0) & (largest < _MAX_RANGE)


def encode_point_cloud2(
    points: NDArray[np.float32],
    stamp: int,
    frame: str,
    *,
    times: NDArray[np.uint32] | NDArray[np.float32] | None = None,
) -> bytes:
    """Return a sensor_msgs/PointCloud2 as CDR.

    Args:
        points: [P, 3] [m].
        stamp: [ns].
        frame: frame of the coordinates.
        times: time of each point after the stamp [P], uint32 [ns] or float32 [s]; None if it is not known.
    """
    time_name = "t" if times is not None and times.dtype == np.uint32 else "time"
    names = ["x", "y", "z"] if times is None else ["x", "y", "z", time_name]
    rows = np.empty(len(points), [(name, "<u4" if name == "t" else "<f4") for name in names])
    for axis, name in enumerate("xyz"):
        rows[name] = points[:, axis]
    if times is not None:
        rows[time_name] = times
    time = message_type("builtin_interfaces/msg/Time")(sec=stamp // 10**9, nanosec=stamp % 10**9)
    make_field = message_type("sensor_msgs/msg/PointField")
    fields = [
        make_field(name=name, offset=4 * i, datatype=6 if name == "t" else 7, count=1) for i, name in enumerate(names)
    ]
    message = message_type(POINT_CLOUD2)(
        header=message_type("std_msgs/msg/Header")(stamp=time, frame_id=frame),
        height=1,
        width=len(rows),
        fields=fields,
        is_bigendian=False,
        point_step=rows.itemsize,
        row_step=rows.nbytes,
        data=np.frombuffer(rows.tobytes(), np.uint8),
        is_dense=True,
    )
    return encode_message(message, POINT_CLOUD2)


def replace_stamp(message: bytes, stamp: int) -> bytes:
    """Return a message of `encode_point_cloud2`, or its head, with another stamp [ns]."""
    return message[:4] + struct.pack("<iI", *divmod(stamp, 10**9)) + message[12:]
