"""Decoding of Livox's CustomMsg, by hand: rosbags would build a Python object per point."""

from __future__ import annotations

import struct

import numpy as np

from aero_viz.input_limits import SWEEP_POINTS_MAX
from aero_viz.recordings.point_cloud2 import RawCloud
from aero_viz.recordings.ros_messages import DamagedMessage

_POINT_SIZE = 19
"""Length of a CustomPoint [bytes]: offset_time [ns], x, y, z [m], reflectivity, tag, line."""


def read_livox(message: bytes | memoryview, encoding: str) -> RawCloud:
    """Return the cloud in a livox_ros_driver(2)/CustomMsg message.

    Raises:
        DamagedMessage: the message is damaged.
    """
    try:
        return _read_cdr(message) if encoding == "cdr" else _read_ros1(message)
    except struct.error as error:
        raise DamagedMessage("it ends within its header") from error


def _read_cdr(message: bytes | memoryview) -> RawCloud:
    # The four bytes before the content do not count for its alignment.
    if len(message) < 4 or message[0] != 0 or message[1] > 1:
        raise DamagedMessage("it does not start as a CDR message")
    order = "><"[message[1]]
    seconds, nanoseconds, length = struct.unpack_from(f"{order}iII", message, 4)
    end = 16 + length
    start = end + -(end - 4) % 8
    # timebase and point_num are not needed; the stamp and the length of the sequence repeat them.
    lidar, count = struct.unpack_from(f"{order}12xB3xI", message, start)
    return _cloud(message, seconds * 10**9 + nanoseconds, (16, end), order, start + 20, count, lidar, step=20)


def _read_ros1(message: bytes | memoryview) -> RawCloud:
    _, seconds, nanoseconds, length = struct.unpack_from("<4I", message)
    end = 16 + length
    lidar, count = struct.unpack_from("<12xB3xI", message, end)
    return _cloud(message, seconds * 10**9 + nanoseconds, (16, end), "<", end + 20, count, lidar, step=_POINT_SIZE)


def _cloud(
    message: bytes | memoryview,
    stamp: int,
    name: tuple[int, int],
    order: str,
    start: int,
    count: int,
    lidar: int,
    *,
    step: int,
) -> RawCloud:
    """Return the cloud of `count` points of a sensor from byte `start` on, `step` bytes apart."""
    frame = bytes(message[slice(*name)]).rstrip(b"\0").decode(errors="replace")
    if not frame.isprintable():
        raise DamagedMessage("a name in it is damaged")
    dtype = np.dtype(
        {
            "names": ["x", "y", "z", "time"],
            "formats": [f"{order}f4", f"{order}f4", f"{order}f4", f"{order}u4"],
            "offsets": [4, 8, 12, 0],
            "itemsize": _POINT_SIZE,
        }
    )
    if count > SWEEP_POINTS_MAX:
        raise DamagedMessage(f"it has {count} points, more than {SWEEP_POINTS_MAX}")
    end = start + (count - 1) * step + _POINT_SIZE if count else start
    if end > len(message):
        raise DamagedMessage(f"it has {len(message)} bytes, but its points end at byte {end}")
    rows = np.ndarray((int(count > 0), count), dtype, message, start, (count * step, step))
    return RawCloud(stamp, frame.lstrip("/"), rows, sensor=f"lidar {lidar}")
