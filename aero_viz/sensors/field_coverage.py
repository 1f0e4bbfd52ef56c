"""Fraction of its field of view that a sensor has covered over time."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import warp as wp
from numpy.typing import NDArray

from aero_planner.warp_init import init_warp
from aero_viz.sensors.lidar import pack_beams
from aero_viz.sensors.lidar_kernels import Beams, beam_direction
from aero_viz.sensors.models import LidarModel

wp.set_module_options({"enable_backward": False})


@wp.kernel
def hit_kernel(
    # problem
    beams: Beams,
    seed: int,
    first: int,
    cell: float,
    # out
    hits: wp.array2d(dtype=int),  # [rows, columns]
):
    """Mark the cell that each ray from `first` on hits; cell: edge of a cell [rad]."""
    i = wp.tid()
    d = beam_direction(beams, first + i, wp.rand_init(seed))
    row = int((wp.asin(wp.clamp(d[2], -1.0, 1.0)) + 0.5 * wp.pi) / cell)
    column = int((wp.atan2(d[1], d[0]) + wp.pi) / cell)
    hits[wp.clamp(row, 0, hits.shape[0] - 1), wp.clamp(column, 0, hits.shape[1] - 1)] = 1


def coverage(
    model: LidarModel, *, times: Sequence[float] = (0.1, 0.5, 1.0), cell: float = 3.0, seed: int = 0
) -> NDArray[np.float64]:
    """Return the fraction of the cells in the field of view that rays have hit after each time, [T].

    The cells are those of the planner's fine partition, in the sensor frame. Only cells that lie completely between the
    edges of the field of view count.

    Args:
        model: model of the LiDAR.
        times: times since the first ray, ascending [s].
        cell: edge of a cell, a divisor of 180 [deg].
        seed: seed of the sensor, which selects where its pattern begins.

    Raises:
        ValueError: `cell` does not divide 180 or exceeds the field of view, or the times do not ascend.
    """
    rows = round(180.0 / cell) if cell > 0.0 else 0
    if rows < 1 or not math.isclose(rows * cell, 180.0) or np.any(np.diff([0.0, *times]) < 0.0):
        raise ValueError(f"cell is {cell!r} and times {times!r}; cell must divide 180 deg and times ascend from 0.")
    edges = -90.0 + cell * np.arange(rows + 1)
    covered = (edges[:-1] >= model.elevation_min - 1e-9) & (edges[1:] <= model.elevation_max + 1e-9)
    sides = -180.0 + cell * np.arange(2 * rows + 1)
    covered = covered[:, None] & (sides[:-1] >= model.azimuth_min - 1e-9) & (sides[1:] <= model.azimuth_max + 1e-9)
    if not covered.any():
        raise ValueError(f"the cell of {cell:g} deg does not fit the field of view of {model.name!r}; make it smaller.")
    init_warp()
    hits = wp.zeros((rows, 2 * rows), dtype=int, device="cpu")
    fractions, first = [], 0
    for time in times:
        end = math.floor(time * model.sweep_rate * model.points_per_sweep + 1e-6)
        inputs = [pack_beams(model), seed & 0x7FFFFFFF, first, math.radians(cell)]
        wp.launch(hit_kernel, end - first, inputs=inputs, outputs=[hits], device="cpu")
        first = end
        fractions.append(hits.numpy()[covered].mean())
    return np.array(fractions)
