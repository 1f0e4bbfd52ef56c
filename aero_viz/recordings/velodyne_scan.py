"""Decoding of velodyne_msgs/VelodyneScan, the packets of one turn, by velodyne-decoder."""

from __future__ import annotations

import importlib.util
import struct
from typing import Any

import numpy as np

from aero_viz.extras import how_to_install
from aero_viz.input_limits import NAME_MAX, SWEEP_POINTS_MAX
from aero_viz.recordings.bag_file import one_line
from aero_viz.recordings.point_cloud2 import RawCloud
from aero_viz.recordings.ros_messages import DamagedMessage
from aero_viz.recordings.velodyne import VELODYNE_POINTS, VELODYNE_SIZE, is_velodyne

VELODYNE_SCAN = "velodyne_msgs/msg/VelodyneScan"
_ROW = np.dtype([(name, "<f4") for name in ("x", "y", "z", "time")])


def read_velodyne_scan(message: bytes | memoryview, encoding: str) -> RawCloud:
    """Return the points of a scan. Its stamp is that of its first packet; the header has that of the last one.

    Of a message whose last packet is zero, as while the topics are looked for, the rows only have the right number.

    Raises:
        DamagedMessage: the message is damaged, or the decoder is not installed.
    """
    if importlib.util.find_spec("velodyne_decoder") is None:
        raise DamagedMessage(f"messages of the type {VELODYNE_SCAN} {how_to_install('formats')}")
    try:
        start = 4 if encoding == "cdr" else 0  # of the content, which CDR aligns; ROS 1 has a sequence number first
        order = ">" if encoding == "cdr" and message[1] == 0 else "<"
        (length,) = struct.unpack_from(f"{order}I", message, 12)
        end = 16 + length
        frame = bytes(message[16 : min(end, 16 + NAME_MAX)]).rstrip(b"\0").decode(errors="replace")
        at = end + -(end - start) % 4 if start else end
        (count,) = struct.unpack_from(f"{order}I", message, at)
        size = 8 + VELODYNE_SIZE
        step = size + -size % 4 if start else size
        if not frame.isprintable():
            raise DamagedMessage("a name in it is damaged")
        if count * VELODYNE_POINTS > SWEEP_POINTS_MAX or (count and at + 4 + (count - 1) * step + size > len(message)):
            raise DamagedMessage(f"it has {len(message)} bytes, too few for {count} packets")
        places = [at + 4 + i * step for i in range(count)]
        stamps = [struct.unpack_from(f"{order}iI", message, place) for place in places]
    except (struct.error, IndexError) as error:
        raise DamagedMessage("it ends within its header") from error
    packets = [bytes(message[place + 8 : place + 8 + VELODYNE_SIZE]) for place in places]
    first = stamps[0][0] * 10**9 + stamps[0][1] if stamps else 0
    if not packets or not is_velodyne(packets[-1]):
        return RawCloud(first, frame.lstrip("/"), np.broadcast_to(np.zeros((1, 1), _ROW), (1, count * VELODYNE_POINTS)))
    times = [1e-9 * (seconds * 10**9 + rest - first) for seconds, rest in stamps]
    return RawCloud(first, frame.lstrip("/"), _decoded(times, packets))


def _decoded(times: list[float], packets: list[bytes]) -> Any:
    """Return the points of packets, and their times after the first packet [s], as rows [1, n]."""
    import velodyne_decoder as decoder

    config = decoder.Config()
    config.timestamp_first_packet = True
    try:
        vector = decoder.PacketVector()
        for time, packet in zip(times, packets, strict=True):
            vector.append(decoder.VelodynePacket(time, packet))  # type: ignore[arg-type]
        _, points = decoder.ScanDecoder(config).decode(vector)
        table: Any = np.asarray(points)
    except Exception as error:  # the decoder fails in many ways on damaged packets
        raise DamagedMessage(f"its packets cannot be decoded ({one_line(error)})") from error
    rows = np.zeros((1, len(table)), _ROW)
    for axis, column in zip("xyz", table.T, strict=False):
        rows[axis] = column
    offsets = table[:, decoder.PointField.time]
    rows["time"] = offsets - (offsets.min() if len(offsets) else 0.0)
    return rows
