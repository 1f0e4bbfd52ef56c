"""The interface between the node and a LiDAR, independent of the protocol."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = ["PointCounters", "PointPacket", "PointSource"]


@dataclass(frozen=True, eq=False)
class PointPacket:
    """Points in the order in which they were measured."""

    points: NDArray[np.float32]
    """[m], shape [n, 3], sensor frame (x forward, y left, z up); finite."""
    times: NDArray[np.float64]
    """When each point was measured, host time (`time.monotonic`) [s], shape [n]; never later than its arrival."""


@dataclass
class PointCounters:
    """Counts of packets and points since the start."""

    packets: int = 0
    """Packets that were used."""
    lost: int = 0
    """Packets missing in the sequence. A packet that arrives late is subtracted again."""
    bad: int = 0
    """Packets that were refused: wrong length, version, type or checksum, or an inconsistent time stamp."""
    duplicates: int = 0
    """Packets that arrived a second time and were refused."""
    points: int = 0
    """Points that were passed on."""
    filtered: int = 0
    """Points that were removed: rays without return, and points that the sensor marks as noise."""


class PointSource(Protocol):
    """A LiDAR. All methods are called from one thread."""

    @property
    def counters(self) -> PointCounters:
        """Counts of packets and points."""
        ...

    def poll(self) -> list[PointPacket]:
        """Return what has arrived since the last call, oldest first. Never blocks; never raises for bad data."""
        ...

    def close(self) -> None:
        """Release the connection."""
        ...
