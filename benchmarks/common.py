"""Parts shared by the benchmarks: the planning problem, the timer and the name of the machine."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from aero_planner import Goal, VehicleState
from aero_planner.forest_cloud import forest_cloud
from aero_planner.warp_init import find_device

__all__ = ["elapsed_ms", "machine", "positive", "situation"]


def situation(points: int, batch: int | None = None) -> tuple[VehicleState, Goal, Any]:
    """Return state, goal and cloud of a drone at 4 m/s in a forest; with a batch, B copies of them."""
    values = ([0.0, 0.0, 2.0], [4.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [30.0, 0.0, 2.0])
    position, velocity, quaternion, goal = (
        np.array(value) if batch is None else np.tile(value, (batch, 1)) for value in values
    )
    cloud: NDArray[np.float32] = forest_cloud(points)
    return VehicleState(position, velocity, quaternion), Goal(goal), cloud if batch is None else [cloud] * batch


def elapsed_ms(work: Callable[[], Any], device: str) -> float:
    """Return the time of `work` [ms], on CUDA between two events of the device's stream."""
    warp_device = wp.get_device(device)
    if not warp_device.is_cuda:
        started = time.perf_counter()
        work()
        return 1e3 * (time.perf_counter() - started)
    with wp.ScopedDevice(warp_device):
        begin, end = wp.Event(warp_device, enable_timing=True), wp.Event(warp_device, enable_timing=True)
        wp.record_event(begin)
        work()
        wp.record_event(end)
        return float(wp.get_event_elapsed_time(begin, end))


def machine(device: str) -> str:
    """Return the name of the processor behind `device`."""
    warp_device = find_device(device)
    if warp_device.is_cuda:
        return warp_device.name
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            names = {line.partition(":")[2].strip() for line in file if line.startswith("model name")}
    except OSError:
        names = set()
    return ", ".join(sorted(names)) or "CPU"


def positive(text: str) -> int:
    """Return the integer, at least 1, that a command-line argument states."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is less than 1")
    return value
