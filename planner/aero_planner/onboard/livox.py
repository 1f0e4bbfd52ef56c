"""The Livox Mid-360 over UDP: parsing of its point packets in both Cartesian formats, and encoding for simulations.

Little-endian, after the vendor's "Livox LiDAR Communication Protocol - Mid360" and Livox-SDK2: a header of 36 bytes
followed by `dot_num` points. `timestamp` is the time of the first point, and `time_interval` the time from the first to
the last point. The checksum is CRC-32 (as in zlib) over timestamp and points. According to the documentation `udp_cnt`
restarts at 0 with each frame, but shipped firmware counts through all 16 bits; both are supported. The sensor sends to
the host address set with Livox Viewer; nothing is ever sent to it.
"""

from __future__ import annotations

import contextlib
import enum
import logging
import socket
import struct
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.onboard.datagram_filter import count_drops, filter_senders
from aero_planner.onboard.host_clock import HostClock
from aero_planner.onboard.interfaces import PointCounters, PointPacket

_log = logging.getLogger(__name__)

CARTESIAN_MM = 1
"""Data type of points in 32-bit millimetres, the sensor's default."""
CARTESIAN_CM = 2
"""Data type of points in 16-bit centimetres."""

_IMU = 0  # data type of the IMU's samples
_HEADER = struct.Struct("<BHHHHBBB12xIQ")
_CHECKED = 28  # offset of the timestamp, where the checksummed part begins
_MAX_POINTS = 1000  # per packet; a real one has 96
_POINT = {
    CARTESIAN_MM: (np.dtype([("xyz", "<i4", 3), ("reflectivity", "u1"), ("tag", "u1")]), np.float32(1e-3)),
    CARTESIAN_CM: (np.dtype([("xyz", "<i2", 3), ("reflectivity", "u1"), ("tag", "u1")]), np.float32(1e-2)),
}
# Bits 0-1, 2-3 and 4-5 of a tag rate how likely the point is a mixture of two objects, rain or dust, or another
# artefact near the sensor: 0 unlikely, 1 possible, 2 likely.
_LIKELY_NOISE = 0b101010
_POSSIBLE_NOISE = 0b111111
_RECEIVE_BUFFER = 4_000_000  # requested size [bytes]; the kernel may give less
_PACKETS_PER_POLL = 256  # six times as many as arrive in a control period
_POLL_TIME = 0.004  # [s] of processor time that a poll may take; what is left waits in the socket
_DATAGRAM_MAX = 16_384  # [bytes]
_TOLERATED = 20  # datagrams of unknown senders after which the kernel drops them


class Reject(enum.Enum):
    """Reason for which a datagram is not a point packet."""

    SHORT = "shorter than a header"
    VERSION = "unknown protocol version"
    TYPE = "not points in Cartesian coordinates"
    LENGTH = "length or number of points does not match the datagram"
    CHECKSUM = "wrong checksum"


@dataclass(frozen=True)
class LivoxPacket:
    """A packet whose header and checksum are valid."""

    stamp_ns: int
    """Time of the first point by the sensor's clock [ns]."""
    interval: float
    """Time from the first to the last point [s]."""
    count: int
    """Number of points."""
    sequence: int
    """Counter of the packets, udp_cnt."""
    data_type: int
    time_type: int
    """Source of the time stamp. 0: time since power-on; 1: PTP; 2: GPS."""
    payload: bytes
    """The encoded points."""


def parse_packet(data: bytes) -> LivoxPacket | Reject:
    """Check a datagram and decode its header. Never raises."""
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


def parse_imu(data: bytes) -> tuple[int, tuple[float, ...]] | None:
    """Return stamp [ns], angular velocity [rad/s] and specific force [g] of the IMU, 6 numbers; None for other data."""
    if len(data) != _HEADER.size + 24 or zlib.crc32(memoryview(data)[_CHECKED:]) != _HEADER.unpack_from(data)[-2]:
        return None
    version, _, _, _, _, _, data_type, _, _, stamp = _HEADER.unpack_from(data)
    return (stamp, struct.unpack_from("<6f", data, _HEADER.size)) if (version, data_type) == (0, _IMU) else None


def decode_points(data_type: int, payload: bytes) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return points [m], shape [n, 3], sensor frame, and tags [n], from the payload of one or more packets."""
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
) -> bytes:
    """Return the datagram that a sensor would send.

    Args:
        points: Sensor frame [m], shape [n, 3]. NaN is a ray without return, which is sent as zeros.
        stamp_ns: Time of the first point by the sensor's clock [ns].
        interval: Time from the first to the last point [s].
        sequence: Counter of the packets, modulo 2^16.
        data_type: CARTESIAN_MM or CARTESIAN_CM.
        tags: One tag per point, or one for all.
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
    header = (0, length, span, len(scaled), sequence & 0xFFFF, 0, data_type, 0, zlib.crc32(checked), stamp_ns)
    return _HEADER.pack(*header) + payload


def noise_mask(keep_uncertain: bool) -> int:
    """Return the bits of a tag of which a point that is passed on has none."""
    return _LIKELY_NOISE if keep_uncertain else _POSSIBLE_NOISE


class LivoxSource:
    """Receives a Mid-360's points; implements `aero_planner.onboard.interfaces.PointSource`.

    Args:
        port: UDP port of the host to listen on; 0 selects a free port.
        host: Address to listen on.
        sensor: Address of the sensor; None accepts packets from anywhere.
        keep_uncertain: Keep points that the sensor rates as possible, but not likely, noise.
        clock: Host time [s].
        stamps: Maps the sensor's stamps to host time; None takes one of its own.

    Raises:
        OSError: The port is in use, or the address is not one of this host.

    Attributes:
        counters: See `PointCounters`.
        rejects: Number of refused datagrams by reason.
        port: UDP port that the source listens on.
    """

    def __init__(
        self,
        port: int = 56301,
        *,
        host: str = "0.0.0.0",
        sensor: str | None = None,
        keep_uncertain: bool = True,
        clock: Callable[[], float] = time.monotonic,
        stamps: HostClock | None = None,
    ) -> None:
        self.counters = PointCounters()
        self.rejects = dict.fromkeys(Reject, 0)
        self._sensor = None if sensor is None else socket.gethostbyname(sensor)
        self._refused = 0
        self._noise = noise_mask(keep_uncertain)
        self._time = clock
        self._clock = stamps or HostClock()
        self._sequence = _Sequence()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            with contextlib.suppress(OSError):  # a smaller buffer may lose packets, which are counted
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
            self._socket.setblocking(False)
            self._socket.bind((host, port))
        except BaseException:
            self._socket.close()
            raise
        self.port: int = self._socket.getsockname()[1]

    def poll(self) -> list[PointPacket]:
        """Return the points that have arrived since the last call, oldest first, joined by data type.

        A flood takes a bounded time. The rest waits in the socket, whose buffer is bounded.
        """
        waiting: list[tuple[LivoxPacket, float]] = []
        result: list[PointPacket] = []
        deadline = time.thread_time() + _POLL_TIME
        for _ in range(_PACKETS_PER_POLL):
            if time.thread_time() > deadline:
                break
            try:
                data, address = self._socket.recvfrom(_DATAGRAM_MAX)
            except OSError:  # nothing has arrived, or an earlier datagram has caused an error
                break
            if self._sensor is not None and address[0] != self._sensor:
                self._refuse(address)
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

    @property
    def dropped_datagrams(self) -> int:
        """Number of datagrams that were dropped: from unknown senders, or for lack of room."""
        return self._refused + count_drops(self._socket)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _refuse(self, address: tuple[str, int]) -> None:
        if self._refused == 0:
            _log.warning("packets from %s:%d are ignored: the LiDAR is at %s", *address, self._sensor)
        self._refused += 1
        if self._refused == _TOLERATED and self._sensor is not None:
            filter_senders(self._socket, [(self._sensor, None)])

    def _admit(self, packet: LivoxPacket) -> float | None:
        """Return the host time of the first point [s]; None for a duplicate or an inconsistent time stamp."""
        # The last point is the newest in the packet, so its delay is the smallest.
        last = self._clock.to_host(1e-9 * packet.stamp_ns + packet.interval, self._time())
        if last is None:
            self.counters.bad += 1
            return None
        lost = self._sequence.lost(packet.sequence)
        if lost is None:
            self.counters.duplicates += 1
            return None
        self.counters.lost = max(0, self.counters.lost + lost)  # late packets may precede the first one
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
    """Counts gaps in 16-bit packet counters."""

    REORDERED = 64
    """Largest number of packets by which a packet may be late."""
    GAP = 1024
    """Steps from this size on are resets of the counter, not losses."""

    def __init__(self) -> None:
        self._newest: int | None = None
        self._seen = 0  # bit i is set if the packet i before the newest has arrived

    def lost(self, number: int) -> int | None:
        """Return the number of newly missing packets, -1 for a late packet; None for a duplicate."""
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
