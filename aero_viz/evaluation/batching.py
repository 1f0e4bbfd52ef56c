"""Batches of flights: their default size and the report of their progress, for benchmarks and tuning."""

from __future__ import annotations

from collections.abc import Callable

import warp as wp

from aero_planner.warp_init import init_warp
from aero_viz.errors import UserError

Progress = Callable[[int, int, str], None]
"""Called with the number of finished flights, the total number, and a description of the current work."""


def batch_status(label: str, finished: int, flights: int, seconds: float) -> str:
    """Return the description of a batch of flights, of which some have finished after a simulated time [s]."""
    return f"{label}: {seconds:.1f} s, {finished} of {flights} finished"


def default_batch(device: str) -> int:
    """Return the default number of simultaneous flights: 256 on a GPU, 1 on a CPU, where batches are not faster.

    Raises:
        UserError: the device is not available.
    """
    init_warp()
    try:
        return 256 if wp.get_device(device).is_cuda else 1
    except ValueError as error:
        raise UserError(f"The device {device!r} is not available: {error}.") from error
