"""Moving obstacles around each drone, estimated from the newest sweeps."""

from __future__ import annotations

from typing import NamedTuple

import warp as wp

from aero_planner.array_memory import allocate
from aero_planner.arrays import MotionArrays, PlannerInputs
from aero_planner.kernels.motion import BINS, BLOCK
from aero_planner.kernels.movers import MOVERS
from aero_planner.kernels.sweep_change import RECENT
from aero_planner.kernels.tracks import STARTS


class _Sizes(NamedTuple):
    B: int
    L: int = int(RECENT)
    A: int = int(BINS)
    K: int = int(BINS) // int(BLOCK)
    X: int = int(MOVERS)
    Y: int = int(STARTS)


class Motion:
    """The moving obstacles around each drone.

    Args:
        inputs: inputs of the planner, which say when and where a sweep arrives if the caller does not.
        params: live parameters, shape [B].

    Attributes:
        arrays: the newest sweep, and what its tracks are made of.
    """

    def __init__(self, inputs: PlannerInputs, params: wp.array) -> None:
        self.inputs, self.params = inputs, params
        self.arrays = allocate(MotionArrays, _Sizes(len(params)), wp.get_device(str(params.device)))
        self.forget()

    def forget(self) -> None:
        """Treat all obstacles as static until the next sweep."""
        self.arrays.newest.fill_(-1)
