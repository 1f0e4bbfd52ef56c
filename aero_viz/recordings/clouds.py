"""Point clouds as they are on the wire: sensor_msgs/PointCloud2 and Livox's CustomMsg, to points in metres."""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["CLOUD_TYPES", "CloudLayout", "DamagedMessage", "cloud_layout", "decode_cloud"]

CLOUD_TYPES = (
    "sensor_msgs/msg/PointCloud2",
    "livox_ros_driver/msg/CustomMsg",
    "livox_ros_driver2/msg/CustomMsg",
)

FARTHEST = 1e4
"""No LiDAR sees farther [m]; a larger coordinate is a damaged one and would overflow later."""

TIME_FIELDS = ("t", "time", "timestamp", "offset_time", "time_offset", "time_stamp")

_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_SHORTEST_SWEEP, _LONGEST_SWEEP = 1e-3, 2.0


class DamagedMessage(ValueError):
    """A message that cannot be decoded; the text says why."""


class CloudLayout(NamedTuple):
    """Where a message keeps its points."""

    stamp: int
    """Time in the header [ns], 0 where the driver set none."""
    frame: str
    """Frame of the coordinates."""
    height: int
    width: int
    dtype: np.dtype
    """One point: x, y, z and, where there is one, time; with the padding of the message."""
    start: int
    """First byte of the first point."""
    row_step: int
    """Bytes from one row to the next."""

    @property
    def count(self) -> int:
        """Number of points, invalid ones included."""
        return self.height * self.width


class _Cursor:
    """Reads scalars from the start of a message: aligned CDR (ROS 2) or packed (ROS 1)."""

    def __init__(self, data: bytes, encoding: str):
        self.data, self.aligned, self.order, self.position = data, encoding == "cdr", "<", 0
        if self.aligned:
            # The encapsulation header counts no alignment; other kinds than plain CDR are not used by ROS 2.
            if len(data) < 4 or data[0] != 0 or data[1] > 1:
                raise DamagedMessage("it does not start as a CDR message")
            self.order, self.position = "><"[data[1]], 4

    def align(self, size: int) -> None:
        if self.aligned:
            self.position += -(self.position - 4) % size

    def scalar(self, code: str) -> int:
        size = struct.calcsize("=" + code)
        self.align(size)
        try:
            (value,) = struct.unpack_from(self.order + code, self.data, self.position)
        except struct.error as error:
            raise DamagedMessage("it ends within its header") from error
        self.position += size
        return value

    def string(self) -> str:
        length = self.scalar("I")
        raw = self.data[self.position : self.position + length]
        if len(raw) < length:
            raise DamagedMessage("it ends within a name")
        self.position += length
        name = raw.rstrip(b"\0").decode(errors="replace")
        if not name.isprintable():
            raise DamagedMessage("a name in it is damaged")
        return name

    def header(self) -> tuple[int, str]:
        """Return stamp [ns] and frame of a std_msgs/Header."""
        if not self.aligned:
            self.scalar("I")  # seq, which ROS 2 dropped
        seconds, nanoseconds = self.scalar("i" if self.aligned else "I"), self.scalar("I")
        return seconds * 10**9 + nanoseconds, self.string().lstrip("/")


def cloud_layout(head: bytes, size: int, kind: str, encoding: str) -> CloudLayout:
    """Return the layout of a cloud from the first bytes of its message, of `size` bytes in all.

    Raises DamagedMessage when the layout contradicts itself or lacks one of x, y, z.
    """
    cursor = _Cursor(head, encoding)
    layout = _pointcloud2(cursor) if kind == CLOUD_TYPES[0] else _livox(cursor)
    used = (layout.height - 1) * layout.row_step + layout.width * layout.dtype.itemsize if layout.count else 0
    if kind != CLOUD_TYPES[0] and layout.count:
        used -= -19 % layout.dtype.itemsize  # the last point has no padding behind it
    if layout.start + used > size:
        raise DamagedMessage(f"it holds {size} bytes and its points would take {layout.start + used}")
    return layout


def _pointcloud2(cursor: _Cursor) -> CloudLayout:
    stamp, frame = cursor.header()
    height, width = cursor.scalar("I"), cursor.scalar("I")
    fields: dict[str, tuple[int, int]] = {}
    for _ in range(cursor.scalar("I")):
        name = cursor.string()
        fields[name] = (cursor.scalar("I"), cursor.scalar("B"))
        cursor.scalar("I")  # count: the first element is the one that matters
    big_endian = bool(cursor.scalar("B"))
    point_step, row_step, length = cursor.scalar("I"), cursor.scalar("I"), cursor.scalar("I")
    missing = [axis for axis in "xyz" if fields.get(axis, (0, 0))[1] not in (7, 8)]
    if missing:
        raise DamagedMessage(
            f"it lacks {', '.join(missing)} as floating-point fields and has {', '.join(fields) or 'no fields'}"
        )
    chosen = {axis: fields[axis] for axis in "xyz"}
    time = next((fields[name] for name in TIME_FIELDS if fields.get(name, (0, 0))[1] in (5, 6, 7, 8)), None)
    if time is not None:
        chosen["time"] = time
    formats = [(">" if big_endian else "<") + _NUMBERS[kind] for _, kind in chosen.values()]
    offsets = [offset for offset, _ in chosen.values()]
    if any(offset + int(code[-1]) > point_step for offset, code in zip(offsets, formats, strict=True)):
        raise DamagedMessage(f"a field lies outside its point_step of {point_step} bytes")
    dtype = np.dtype({"names": list(chosen), "formats": formats, "offsets": offsets, "itemsize": point_step})
    # Several drivers leave row_step unset in clouds of one row, where it has no meaning.
    row_step = row_step if height > 1 and row_step else width * point_step
    if row_step < width * point_step or (height and (height - 1) * row_step + width * point_step > length):
        raise DamagedMessage(f"{height} x {width} points of {point_step} bytes do not fit into {length} bytes")
    return CloudLayout(stamp, frame, height, width, dtype, cursor.position, row_step)


def _livox(cursor: _Cursor) -> CloudLayout:
    stamp, frame = cursor.header()
    cursor.scalar("Q")  # timebase: the stamp of the first point, which the header repeats
    cursor.scalar("I")  # point_num: repeated by the sequence's length
    for _ in range(4):
        cursor.scalar("B")  # lidar_id and three reserved bytes
    count = cursor.scalar("I")
    cursor.align(4)
    step = 20 if cursor.aligned else 19
    codes = [cursor.order + code for code in ("f4", "f4", "f4", "u4")]
    dtype = np.dtype({"names": ["x", "y", "z", "time"], "formats": codes, "offsets": [4, 8, 12, 0], "itemsize": step})
    return CloudLayout(stamp, frame, int(count > 0), count, dtype, cursor.position, count * step)


def decode_cloud(data: bytes, layout: CloudLayout) -> tuple[NDArray[np.float32], NDArray[np.float32] | None, int]:
    """Return points [m] (P, 3), their times after the stamp [s] (P,) or None, and how many rows were dropped.

    Dropped are rows that are not finite, lie beyond any LiDAR's range, or are exactly zero, which is how spinning
    LiDARs report "no return".
    """
    if not layout.count:
        return np.empty((0, 3), np.float32), None, 0
    step = layout.dtype.itemsize
    short = layout.start + (layout.height - 1) * layout.row_step + layout.width * step - len(data)
    if short > 0:
        data = data + bytes(short)
    rows = np.ndarray((layout.height, layout.width), layout.dtype, data, layout.start, (layout.row_step, step))
    with np.errstate(over="ignore", invalid="ignore"):
        points = np.stack([rows[axis].reshape(-1) for axis in "xyz"], axis=1).astype(np.float32, copy=False)
        # NaN compares false; one maximum answers both questions.
        reach = np.abs(points).max(axis=1)
        valid = (reach > 0) & (reach < FARTHEST)
    times = _point_times(rows["time"].reshape(-1), layout.stamp) if "time" in (layout.dtype.names or ()) else None
    if valid.all():
        return np.ascontiguousarray(points), times, 0
    return points[valid], None if times is None else times[valid], int(len(valid) - valid.sum())


def _point_times(values: NDArray, stamp: int) -> NDArray[np.float32] | None:
    """Return times after the stamp [s], or None where the field makes no sense as time.

    Drivers write seconds, milliseconds, microseconds or nanoseconds, counted from the stamp, from 1970 or from the
    sensor's start, and nothing in the message says which. A sweep lasts between 1 ms and 2 s: that settles the unit.
    """
    units = (1.0, 1e-9, 1e-6, 1e-3) if values.dtype.kind == "f" else (1e-9, 1e-6, 1e-3)
    times = values.astype(np.float64)
    if not np.isfinite(times).all():
        return None
    first, last = float(times.min()), float(times.max())
    unit = next((unit for unit in units if _SHORTEST_SWEEP <= (last - first) * unit <= _LONGEST_SWEEP), None)
    if unit is None:
        return None
    if abs(first * unit) <= _LONGEST_SWEEP:
        return (times * unit).astype(np.float32)
    lead = first * unit - stamp * 1e-9
    # Absolute times on another clock than the stamp's: the stamp is then the first point's.
    lead = lead if abs(lead) <= _LONGEST_SWEEP else 0.0
    return ((times - first) * unit + lead).astype(np.float32)
