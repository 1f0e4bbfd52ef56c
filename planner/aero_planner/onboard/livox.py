"""The Livox Mid-360 over UDP: its point packets in both Cartesian formats, parsed and, for simulations, made.

Little-endian, from the vendor's "Livox LiDAR Communication Protocol - Mid360" and Livox-SDK2: a header of 36 bytes,
then `dot_num` points. `timestamp` is the time of the first point, `time_interval` spans from the first to the last.
The checksum is CRC-32 (zlib's) over timestamp and points. The documentation sets `udp_cnt` to 0 at each frame, while
shipped firmware counts on through all 16 bits; both are understood. The sensor sends by itself to the host it was told
with Livox Viewer; nothing is ever sent to it.
"""

from __future__ import annotations

import contextlib
import enum
import socket
import struct
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.onboard.host_clock import HostClock
from aero_planner.onboard.point_source import PointCounters, PointPacket

__all__ = ["CARTESIAN_CM", "CARTESIAN_MM", "LivoxPacket", "LivoxSource", "Reject", "encode_packet", "parse_packet"]

CARTESIAN_MM = 1
"""Data type of points in 32-bit millimetres, the sensor's default."""
CARTESIAN_CM = 2
"""Data type of points in 16-bit centimetres."""

_HEADER = struct.Struct("<BHHHHBBB12xIQ")
_CHECKED = 28  # the checksum covers everything from the timestamp on
_MAX_POINTS = 1000  # per packet; a real one has 96
_POINT = {
    CARTESIAN_MM: (np.dtype([("xyz", "<i4", 3), ("reflectivity", "u1"), ("tag", "u1")]), np.float32(1e-3)),
    CARTESIAN_CM: (np.dtype([("xyz", "<i2", 3), ("reflectivity", "u1"), ("tag", "u1")]), np.float32(1e-2)),
}
# Bits 0-1, 2-3 and 4-5 of a tag say how likely the point is glue between two objects, rain or dust, or another artefact
# near the sensor: 0 not, 1 perhaps, 2 likely.
_LIKELY_NOISE = 0b101010
_PERHAPS_NOISE = 0b111111
_RECEIVE_BUFFER = 4_000_000  # asked for; the kernel may give less
_PACKETS_PER_POLL = 1024  # half a second of them: a flood cannot hold the caller


class Reject(enum.Enum):
    """Why a datagram is no point packet."""

    SHORT = "shorter than a header"
    VERSION = "unknown protocol version"
    TYPE = "not points in Cartesian coordinates"
    LENGTH = "length and number of points do not fit the datagram"
    CHECKSUM = "wrong checksum"


@dataclass(frozen=True)
class LivoxPacket:
    """A checked packet."""

    stamp_ns: int
    """Time of the first point by the sensor's clock [ns]."""
    interval: float
    """Time from the first to the last point [s]."""
    count: int
    """Number of points."""
    sequence: int
    """udp_cnt."""
    data_type: int
    time_type: int
    """0: since power-on; 1: PTP; 2: GPS."""
    payload: bytes
    """The points as they came."""


def parse_packet(data: bytes) -> LivoxPacket | Reject:
    """Check a datagram and take its header apart; never raises."""
    if len(data) < _HEADER.size:
        return Reject.SHORT
    version, length, interval, count, sequence, _, data_type, time_type, checksum, stamp = _HEADER.unpack_from(data)
    if version != 0:
        return Reject.VERSION
    if data_type not in _POINT:
        return Reject.TYPE
    size = _HEADER.size + count * _POINT[data_type][0].itemsize
    if length != len(data) or size != len(data) or not 0 < count <= _MAX_POINTS:
        return Reject.LENGTH
    if zlib.crc32(memoryview(data)[_CHECKED:]) != checksum:
        return Reject.CHECKSUM
    return LivoxPacket(stamp, 1e-7 * interval, count, sequence, data_type, time_type, data[_HEADER.size :])


def decode_points(data_type: int, payload: bytes) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return points [m], shape [n, 3], sensor frame, and their tags [n], from the payload of one or more packets."""
    kind, unit = _POINT[data_type]
    records = np.frombuffer(payload, dtype=kind)
    return records["xyz"].astype(np.float32) * unit, records["tag"]


def encode_packet(
    points: ArrayLike,
    *,
    stamp_ns: int,
    interval: float,
    sequence: int,
    data_type: int = CARTESIAN_MM,
    tags: ArrayLike = 0,
    time_type: int = 0,
) -> bytes:
    """Return the datagram that a sensor would send.

    Args:
        points: [m], shape [n, 3], sensor frame; NaN is a ray without return, which is sent as zeros.
        stamp_ns: time of the first point by the sensor's clock [ns].
        interval: time from the first to the last point [s].
        sequence: counts packets, modulo 2^16.
        data_type: CARTESIAN_MM or CARTESIAN_CM.
        tags: one per point, or one for all.
        time_type: 0: since power-on; 1: PTP; 2: GPS.
    """
    kind, unit = _POINT[data_type]
    scaled = np.rint(np.asarray(points, dtype=np.float64) * (1.0 / float(unit)))
    scaled[np.isnan(scaled)] = 0.0
    records: Any = np.zeros(len(scaled), dtype=kind)
    limits = np.iinfo(kind["xyz"].base)
    records["xyz"] = np.minimum(np.maximum(scaled, limits.min), limits.max)
    records["tag"] = tags
    payload = records.tobytes()
    checked = struct.pack("<Q", stamp_ns) + payload
    length = _HEADER.size + len(payload)
    span = round(interval * 1e7)
    header = (0, length, span, len(scaled), sequence & 0xFFFF, 0, data_type, time_type, zlib.crc32(checked), stamp_ns)
    return _HEADER.pack(*header) + payload


class LivoxSource:
    """Receives a Mid-360's points; implements `aero_planner.onboard.point_source.PointSource`.

    Args:
        port: UDP port of the host to listen on; 0 for any free one, see `port`.
        host: address to listen on.
        sensor: address of the sensor; None takes packets from anywhere.
        keep_uncertain: keep points that the sensor thinks perhaps, not likely, to be noise.
        clock: host time [s].

    Raises:
        OSError: the port is taken, or the address is not this host's.

    Attributes:
        counters: see `PointCounters`.
        rejects: how many datagrams were refused for which reason.
        port: UDP port that is listened on.
    """

    def __init__(
        self,
        port: int = 56301,
        *,
        host: str = "0.0.0.0",
        sensor: str | None = None,
        keep_uncertain: bool = True,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.counters = PointCounters()
        self.rejects = dict.fromkeys(Reject, 0)
        self._sensor = sensor
        self._noise = _LIKELY_NOISE if keep_uncertain else _PERHAPS_NOISE
        self._time = clock
        self._clock = HostClock()
        self._sequence = _Sequence()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            with contextlib.suppress(OSError):  # a smaller buffer loses packets, which are counted
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
            self._socket.setblocking(False)
            self._socket.bind((host, port))
        except BaseException:
            self._socket.close()
            raise
        self.port: int = self._socket.getsockname()[1]

    def poll(self) -> list[PointPacket]:
        """Return the points that have arrived since the last call, oldest first, joined per data type.

        At most half a second of packets is taken at once; the rest waits in the socket, whose buffer is bounded.
        """
        waiting: list[tuple[LivoxPacket, float]] = []
        result: list[PointPacket] = []
        for _ in range(_PACKETS_PER_POLL):
            try:
                data, address = self._socket.recvfrom(65535)
            except OSError:  # nothing there, or an error that an earlier datagram left behind
                break
            if self._sensor is not None and address[0] != self._sensor:
                continue
            packet = parse_packet(data)
            if isinstance(packet, Reject):
                self.rejects[packet] += 1
                self.counters.bad += 1
                continue
            first = self._admit(packet)
            if first is None:
                continue
            if waiting and waiting[-1][0].data_type != packet.data_type:
                result.append(self._join(waiting))
                waiting = []
            waiting.append((packet, first))
        if waiting:
            result.append(self._join(waiting))
        return result

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _admit(self, packet: LivoxPacket) -> float | None:
        """Return the host time of the first point [s]; None for a packet that came before or does not fit."""
        # The last point is the newest thing in the packet, so that its delay is the smallest.
        last = self._clock.to_host(1e-9 * packet.stamp_ns + packet.interval, self._time())
        if last is None:
            self.counters.bad += 1
            return None
        lost = self._sequence.lost(packet.sequence)
        if lost is None:
            self.counters.duplicates += 1
            return None
        self.counters.lost = max(0, self.counters.lost + lost)  # late ones may date from before the first
        self.counters.packets += 1
        return last - packet.interval

    def _join(self, packets: list[tuple[LivoxPacket, float]]) -> PointPacket:
        points, tags = decode_points(packets[0][0].data_type, b"".join(packet.payload for packet, _ in packets))
        counts = np.array([packet.count for packet, _ in packets])
        first = np.array([time for _, time in packets])
        step = np.array([packet.interval / max(packet.count - 1, 1) for packet, _ in packets])
        number = np.arange(len(points)) - np.repeat(np.cumsum(counts) - counts, counts)
        times: Any = np.repeat(first, counts) + number * np.repeat(step, counts)
        kept = (tags & self._noise == 0) & points.any(axis=1)
        self.counters.points += int(kept.sum())
        self.counters.filtered += int(len(points) - kept.sum())
        return PointPacket(points[kept], times[kept])


class _Sequence:
    """Counts gaps in 16-bit sequence numbers."""

    REORDERED = 64
    """Farthest that a packet may come late."""
    GAP = 1024
    """A larger step is no loss: the counter was reset."""

    def __init__(self) -> None:
        self._newest: int | None = None
        self._seen = 0  # bit i: the packet i before the newest has come

    def lost(self, number: int) -> int | None:
        """Return how many more packets than before are missing, -1 for a late one; None for one that came twice."""
        step = 0 if self._newest is None else (number - self._newest) & 0xFFFF
        back = -step & 0xFFFF
        if self._newest is not None and back < self.REORDERED:
            if self._seen >> back & 1:
                return None
            self._seen |= 1 << back
            return -1
        gap = self._newest is not None and step < self.GAP
        self._seen = (self._seen << step | 1) & (1 << self.REORDERED) - 1 if gap else 1
        self._newest = number
        return step - 1 if gap else 0
