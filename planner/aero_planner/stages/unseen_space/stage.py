"""The stage that continues surfaces into unseen space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from aero_planner.array_memory import array
from aero_planner.config import PlannerConfig
from aero_planner.costs import CostTerm
from aero_planner.recorder import Recorder
from aero_planner.stage import Hooks, Launches, Stage
from aero_planner.stages.unseen_space import continuation
from aero_planner.stages.unseen_space.continuation import CONTINUED, READ_ROWS
from aero_planner.stages.unseen_space.view import look_ahead, tilt_cost

_NAME = "unseen_space"


@dataclass(eq=False)
class Arrays:
    """Surfaces at the edges of the view, and the attitude for which the view holds."""

    surfaces: wp.array = array(wp.vec2, "B 2 Y", "m", "Nearest surface to continue: distance, horizontal, and height.")
    view_quaternion: wp.array = array(
        wp.vec4, "B", "", "Attitude, body to world, that lags by `view_age` on average.", kept="plans"
    )


def _symbols(F0: int, F1: int) -> dict[str, int]:
    """Return Y: the fine cells, with the rows rounded up to whole multiples of those that are read at once."""
    return {"Y": -(-F0 // int(READ_ROWS)) * int(READ_ROWS) * F1}


def _follow(r: Recorder) -> list[list[Launches]]:
    view = r.stage_arrays(_NAME).view_quaternion
    inputs = [r.problem, r.params, r.previous]
    return [[[r.record(continuation.follow_attitude, (r.sizes.B,), inputs=inputs, outputs=[view])]]]


def _continue(r: Recorder) -> list[list[Launches]]:
    """Find surfaces, the nearest ones above and below each cell, and fill; every worker has its share of the cells."""
    a, sizes = r.stage_arrays(_NAME), r.sizes
    columns = (sizes.B, 2, -(-sizes.F1 // sizes.W))

    def shared(kernel: Any, size: tuple[int, ...], inputs: list[Any], outputs: list[Any], block_dim: int = 256) -> Any:
        return [
            [r.record(kernel, size, inputs=[worker, sizes.W, *inputs], outputs=outputs, block_dim=block_dim)]
            for worker in range(sizes.W)
        ]

    cells = r.threads_of_cells(sizes.W)
    return [
        shared(
            continuation.find_edges(r.tuning), cells, [r.problem, r.params, a.view_quaternion, r.cells], [a.surfaces]
        ),
        shared(continuation.find_nearest_surfaces, columns, [r.params, sizes.F0, sizes.F1], [a.surfaces], 32),
        shared(
            continuation.continue_surfaces(r.tuning),
            cells,
            [r.problem, r.params, a.view_quaternion, a.surfaces],
            [r.cells],
        ),
    ]


def _continued_cells(values: Any, config: PlannerConfig, batched: bool) -> NDArray[np.bool_]:
    """Return True for each fine cell whose range is that of a continued surface, shape [B, rows, columns]."""
    cells = (values["occupied"] == int(CONTINUED)).reshape(-1, *config.fine_shape)
    return cells if batched else cells[0]


STAGE = Stage(
    name=_NAME,
    label="Unseen space",
    arrays=Arrays,
    reports={"continued_cells": _continued_cells},
    symbols=_symbols,
    hooks=Hooks(turn=look_ahead),
    terms=(CostTerm("tilt", "tilt beyond the view", running=tilt_cost),),
    launches={"start": _follow, "cells": _continue},
)
