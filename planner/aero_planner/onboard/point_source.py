"""What the node gets from a LiDAR, whatever the protocol."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = ["PointCounters", "PointPacket", "PointSource"]


@dataclass(frozen=True, eq=False)
class PointPacket:
    """Points measured one after the other."""

    points: NDArray[np.float32]
    """[m], shape [n, 3], sensor frame: x forward, y left, z up of the sensor; finite."""
    times: NDArray[np.float64]
    """When each was measured, host time (`time.monotonic`) [s], shape [n]; never later than its arrival."""


@dataclass
class PointCounters:
    """What has come and what has not, since the start."""

    packets: int = 0
    """Packets that were used."""
    lost: int = 0
    """Packets missing in the sequence; one that comes late is taken off again."""
    bad: int = 0
    """Packets that were refused: wrong length, version, type or checksum, or a stamp that does not fit the others."""
    duplicates: int = 0
    """Packets that came twice; the second is refused."""
    points: int = 0
    """Points that were given on."""
    filtered: int = 0
    """Points left out: rays without return, and what the sensor itself takes for noise."""


class PointSource(Protocol):
    """A LiDAR. Called from one thread."""

    @property
    def counters(self) -> PointCounters:
        """What has come and what has not."""
        ...

    def poll(self) -> list[PointPacket]:
        """Return what has arrived since the last call, oldest first; never blocks, never raises for what came."""
        ...

    def close(self) -> None:
        """Release the connection."""
        ...
