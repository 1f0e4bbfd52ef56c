"""Device memory of flights, which limits the size of a batch."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from aero_planner import PlannerConfig
from aero_viz.flight.batch import FlightBatch
from aero_viz.scenes.world import World
from aero_viz.sensors.lidar import LidarModel

__all__ = ["device_bytes", "memory_per_flight"]


def device_bytes(owner: Any) -> int:
    """Return the size of the Warp arrays [bytes] that `owner` refers to; shared memory counts once.

    References are followed through lists, dicts and objects of this project.
    """
    spans = sorted({(a.ptr, a.ptr + a.capacity) for a in _arrays(owner, set()) if a.ptr})
    total = end = 0
    for first, last in spans:
        total += max(0, last - max(first, end))
        end = max(end, last)
    return total


def memory_per_flight(*, config: PlannerConfig | None = None, lidar: LidarModel | None = None) -> int:
    """Return the memory that each flight adds to a `FlightBatch`, without its world [bytes].

    It is measured as the difference between batches of two flights and of one on the CPU. With one thread, the CPU has
    the memory layout of a GPU.

    Args:
        config: configuration of the planner; None is the default.
        lidar: None is the Livox Mid-360. Its sweeps take the largest part.
    """
    world = World("empty", np.zeros(3), np.array([9.0, 0.0, 0.0]))
    batches = [FlightBatch([world] * count, config=config, lidar=lidar, threads=1) for count in (1, 2)]
    single, double = (device_bytes(batch) for batch in batches)
    return double - single


def _arrays(value: Any, seen: set[int]) -> Iterator[wp.array]:
    if id(value) in seen:
        return
    seen.add(id(value))
    if isinstance(value, wp.array):
        yield value
    elif isinstance(value, (list, tuple)):
        for item in value:
            yield from _arrays(item, seen)
    elif isinstance(value, (dict, SimpleNamespace)) or type(value).__module__.startswith("aero_"):
        content = value if isinstance(value, dict) else getattr(value, "__dict__", {})
        for item in list(content.values()):
            yield from _arrays(item, seen)
