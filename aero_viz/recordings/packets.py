"""Raw packets of LiDARs in captures of a network: whose they are, and those of the Livox Mid-360.

`ouster.py` reads those of Ouster's.
"""

from __future__ import annotations

import contextlib
import itertools
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from aero_planner.onboard.livox import LivoxPacket, decode_points, parse_imu, parse_packet
from aero_viz.errors import UserError
from aero_viz.input_limits import SWEEP_POINTS_MAX
from aero_viz.recordings.cloud_files import StampedCloud
from aero_viz.recordings.imu_messages import GRAVITY, ImuRows
from aero_viz.recordings.ouster import find_metadata
from aero_viz.recordings.pcap import Datagram, udp_payloads
from aero_viz.recordings.sensors import choose_sensor
from aero_viz.recordings.velodyne import VELODYNE_POINTS, is_velodyne

_SWEEP = 100_000_000
"""A Livox does not rotate: the packets of this period form a sweep [ns]."""
_OUSTER_PORT = 7502
_PROBED = 2000


class _Kind(NamedTuple):
    """A kind of packets that sensors send."""

    name: str
    fits: Callable[[Datagram], bool]


_READ = [
    _Kind("livox", lambda datagram: isinstance(parse_packet(datagram.payload), LivoxPacket)),
    _Kind("velodyne", lambda datagram: is_velodyne(datagram.payload)),
    _Kind("ouster", lambda datagram: datagram.port == _OUSTER_PORT),
]
_UNREAD = [
    _Kind("a Hesai", lambda datagram: datagram.payload[:2] == b"\xee\xff"),
    _Kind("a RoboSense", lambda datagram: datagram.payload.startswith((b"\x55\xaa", b"\xa5\xff\x00\x5a"))),
    _Kind(
        "a Livox of the first generation",
        lambda datagram: datagram.payload[:1] == b"\5" and len(datagram.payload) in (1318, 1362),
    ),
    _Kind("an LSLiDAR", lambda datagram: datagram.payload[:2] == b"\xff\xee" and len(datagram.payload) == 1212),
]


def pcap_kind(path: Path) -> str:
    """Return "livox", "velodyne" or "ouster": the kind of most of the first packets of a capture.

    An Ouster that does not use its default port is recognized by its metadata, a JSON file in the same folder.

    Raises:
        UserError: they are none of these.
    """
    counts: Counter[str] = Counter()
    with contextlib.suppress(EOFError, ValueError):  # reported once the sweeps are read
        for datagram in itertools.islice(udp_payloads(path), _PROBED):
            counts["UDP"] += 1
            counts.update(kind.name for kind in (*_READ, *_UNREAD) if kind.fits(datagram))
    known = [kind.name for kind in _READ if counts[kind.name]]
    if known:
        return max(known, key=lambda name: counts[name])
    if find_metadata(path):
        return "ouster"
    foreign = next((kind.name for kind in _UNREAD if counts[kind.name]), None)
    if foreign:
        raise UserError(
            f"{path} holds packets of {foreign}, which AERO-Viz does not decode: let the driver of the sensor replay "
            "them, and record its PointCloud2 topic."
        )
    held = f"the first {counts['UDP']} of UDP are of another kind" if counts["UDP"] else "it has none of UDP"
    raise UserError(
        f"{path} has no packets of a Livox Mid-360, a Velodyne or an Ouster ({held}): capture the sensor's UDP port; "
        "an Ouster on a port other than 7502 needs its metadata (JSON) in the same folder."
    )


class Captured(NamedTuple):
    """The packets of one sensor of a capture."""

    datagrams: Callable[[], Iterator[Datagram]]
    notice: str
    """Sentence on the sensors that are left out; empty if there are none."""


def packets_of_sensor(path: Path, kind: str, wanted: str | None) -> Captured:
    """Return the packets of one Livox or Velodyne of a capture, and those of its IMU.

    A sensor is known by its address and, unless it is a Livox, by the port that it sends to.

    Args:
        path: the capture.
        kind: "livox" or "velodyne".
        wanted: see `choose_sensor`.

    Raises:
        UserError: no sensor has the wanted name.
    """

    def name(datagram: Datagram) -> str:
        return datagram.source if kind == "livox" else f"{datagram.source}:{datagram.port}"

    counts: Counter[str] = Counter()
    with contextlib.suppress(EOFError, ValueError):
        for datagram in udp_payloads(path):
            if kind == "velodyne":
                counts[name(datagram)] += VELODYNE_POINTS * is_velodyne(datagram.payload)
            elif isinstance(packet := parse_packet(datagram.payload), LivoxPacket):
                counts[name(datagram)] += packet.count
    chosen, notice = choose_sensor(+counts, wanted, path)
    return Captured(lambda: (datagram for datagram in udp_payloads(path) if name(datagram) == chosen), notice)


def velodyne_packets(datagrams: Iterable[Datagram]) -> Iterator[tuple[int, bytes]]:
    """Yield the times of capture [ns] and the point packets of a Velodyne."""
    return ((datagram.time, datagram.payload) for datagram in datagrams if is_velodyne(datagram.payload))


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


def pcap_livox_packets(datagrams: Iterable[Datagram], imu: ImuRows) -> Iterator[LivoxPacket]:
    """Yield the point packets of a Livox, and add the samples of the IMU among its packets to `imu`."""
    for datagram in datagrams:
        packet = parse_packet(datagram.payload)
        if isinstance(packet, LivoxPacket):
            yield packet
        elif (sample := parse_imu(datagram.payload)) is not None:
            imu.add(sample[0], sample[1][:3], [GRAVITY * value for value in sample[1][3:]])
