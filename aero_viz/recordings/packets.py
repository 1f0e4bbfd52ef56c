"""Raw packets of LiDARs: Livox's .lvx2, and .pcap captures of the Livox Mid-360 and of Velodyne's sensors.

`ouster.py` reads those of Ouster's.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from aero_planner.onboard.livox import LivoxPacket, decode_points, parse_imu, parse_packet
from aero_planner.user_file import open_user_file
from aero_viz.errors import UserError
from aero_viz.input_limits import SWEEP_POINTS_MAX
from aero_viz.recordings.bag_file import one_line
from aero_viz.recordings.cloud_files import StampedCloud
from aero_viz.recordings.imu_messages import GRAVITY, ImuRows
from aero_viz.recordings.ouster import find_metadata
from aero_viz.recordings.pcap import udp_payloads

LVX_MAGIC = b"livox_tech"
_SWEEP = 100_000_000
"""A Livox does not rotate: the packets of this period form a sweep [ns]."""
_LVX_HEADER, _LVX_DEVICE, _LVX_FRAME = 24 + 5, 63, 24
_LVX_PACKAGE = struct.Struct("<BIBBQHBIB4x")
_POINT_SIZES = {1: 14, 2: 8}
_POINT_INTERVAL = 1e9 / 200_000  # of a Mid-360 [ns]; .lvx2 does not say
_VELODYNE = 1206
_OUSTER_PORT = 7502
_TIME_MAX = 2**32 - 1  # [ns]
_PACKAGE_MAX = 1 << 20
_PROBED = 2000


def pcap_kind(path: Path) -> str:
    """Return "livox", "velodyne" or "ouster": the kind of most of the first packets of a capture.

    An Ouster that does not use its default port is recognized by its metadata, a JSON file in the same folder.

    Raises:
        UserError: they are none of these.
    """
    counts = {"livox": 0, "velodyne": 0, "ouster": 0}
    with contextlib.suppress(EOFError, ValueError):  # reported once the sweeps are read
        for datagram in itertools.islice(udp_payloads(path), _PROBED):
            payload = datagram.payload
            counts["livox"] += isinstance(parse_packet(payload), LivoxPacket)
            counts["velodyne"] += len(payload) == _VELODYNE and payload[:2] == b"\xff\xee"
            counts["ouster"] += datagram.port == _OUSTER_PORT
    kind = max(counts, key=lambda name: counts[name])
    if not counts[kind]:
        if find_metadata(path):
            return "ouster"
        raise UserError(
            f"{path} has no packets of a Livox Mid-360, a Velodyne or an Ouster: capture the sensor's UDP port; an "
            "Ouster on a port other than 7502 needs its metadata (JSON) in the same folder."
        )
    return kind


def livox_sweeps(packets: Iterator[LivoxPacket]) -> Iterator[StampedCloud]:
    """Yield sweeps of 100 ms from the packets of a Livox, without the rays that returned nothing.

    Raises:
        ValueError: a sweep has too many points.
    """
    for _, group in itertools.groupby(packets, lambda packet: packet.stamp_ns // _SWEEP):
        parts, times, start, count = [], [], None, 0
        for packet in group:
            count += packet.count
            if count > SWEEP_POINTS_MAX:
                raise ValueError(
                    f"damaged, a sweep has over {SWEEP_POINTS_MAX} points: only the data before it is used"
                )
            start = packet.stamp_ns if start is None else start
            points, _ = decode_points(packet.data_type, packet.payload)
            step = 1e9 * packet.interval / max(len(points) - 1, 1)
            offsets = packet.stamp_ns - start + step * np.arange(len(points))
            hit = (points != 0.0).any(axis=1) & (offsets >= 0.0)
            parts.append(points[hit])
            times.append(offsets[hit].astype(np.uint32))
        if start is not None:
            yield StampedCloud(start, np.concatenate(parts), np.concatenate(times))


def pcap_livox_packets(path: Path, imu: ImuRows) -> Iterator[LivoxPacket]:
    """Yield the point packets of a capture, and add the samples of the IMU among them to `imu`."""
    for datagram in udp_payloads(path):
        packet = parse_packet(datagram.payload)
        if isinstance(packet, LivoxPacket):
            yield packet
        elif (sample := parse_imu(datagram.payload)) is not None:
            imu.add(sample[0], sample[1][:3], [GRAVITY * value for value in sample[1][3:]])


def lvx2_packets(path: Path) -> Iterator[LivoxPacket]:
    """Yield the point packets of a .lvx2 file.

    Raises:
        UserError: it is a file of Livox's older format.
        EOFError: it is truncated.
        ValueError: it is damaged.
    """
    with open_user_file(path) as file:
        head = file.read(_LVX_HEADER)
        if len(head) < _LVX_HEADER or head[16] != 2:
            raise UserError(f"{path} is not an .lvx2 file (version 2); export it again with Livox Viewer 2.")
        file.seek(_LVX_HEADER + _LVX_DEVICE * head[28])
        while frame := file.read(_LVX_FRAME):
            if len(frame) < _LVX_FRAME:
                raise EOFError
            here, after, _ = struct.unpack("<3Q", frame)
            end = file.tell() - _LVX_FRAME + (after - here)
            while file.tell() < end:
                yield _lvx2_packet(file)


def _lvx2_packet(file: BinaryIO) -> LivoxPacket:
    header = file.read(_LVX_PACKAGE.size)
    if len(header) < _LVX_PACKAGE.size:
        raise EOFError
    _, _, _, time_type, stamp, sequence, kind, length, _ = _LVX_PACKAGE.unpack(header)
    size = _POINT_SIZES.get(kind)
    if length > _PACKAGE_MAX or size is None or length % size:
        raise ValueError(
            f"damaged, a package claims {length} bytes of points of type {kind}: only the data before it is used"
        )
    payload = file.read(length)
    if len(payload) < length:
        raise EOFError
    count = length // size
    interval = 1e-9 * _POINT_INTERVAL * max(count - 1, 0)
    return LivoxPacket(stamp, interval, count, sequence, kind, time_type, payload)


def velodyne_sweeps(path: Path) -> Iterator[StampedCloud]:
    """Yield the sweeps of a capture of a Velodyne.

    Raises:
        UserError: velodyne-decoder is not installed.
        ValueError: the capture is damaged.
    """
    try:
        import velodyne_decoder as decoder
    except ImportError as error:
        raise UserError(
            f"velodyne-decoder is not installed ({error}): pip install 'aero-viz[formats]' to read {path}."
        ) from error
    config = decoder.Config()
    config.timestamp_first_packet = True
    with open_user_file(path) as file:
        clouds = decoder.read_pcap(file, config)
        while True:
            try:
                stamp, points = next(clouds)
            except StopIteration:
                return
            except Exception as error:  # the decoder fails in many ways on damaged captures
                raise ValueError(f"damaged ({one_line(error)}): only the data before it is used") from error
            table: Any = np.asarray(points)
            offsets = table[:, decoder.PointField.time].astype(np.float64)
            start = float(offsets.min()) if len(offsets) else 0.0
            host = float(getattr(stamp, "host", stamp))
            if not math.isfinite(host + start):
                raise ValueError("damaged, a time is not finite: only the data before it is used")
            times = np.clip(np.round(1e9 * (offsets - start)), 0, _TIME_MAX).astype(np.uint32)
            yield StampedCloud(round(1e9 * (host + start)), table[:, :3].astype(np.float32), times)
