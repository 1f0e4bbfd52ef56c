"""The noise that a planner samples, in host memory, for another planner that is to plan with the same samples."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from aero_planner.kernels.mppi import NOISE_STEP

if TYPE_CHECKING:
    from aero_planner.planner import Planner


def noise_of_next_plan(planner: Planner) -> NDArray[np.float32]:
    """Return the white noise of unit variance with which a planner samples next, shape [B, M, K, N, 4].

    The samples of an instance use consecutive sequences of the planner's table from a random one on, with random signs.
    """
    table: Any = planner.workspace.noise.numpy()
    sampling, rows = planner.config.sampling, table.shape[2]
    ticks: Any = planner.workspace.tick.numpy() * int(sampling.fresh_noise)
    seeds: Any = planner.workspace.seed.numpy() + np.int32(7919) * ticks
    noise = np.empty((len(seeds), len(planner.config.kinds), sampling.samples, *table.shape[:2]), dtype=np.float32)
    for b, m in np.ndindex(noise.shape[:2]):
        bits = int(wp.rand_init(int(seeds[b]), m)) & 0x7FFFFFFF
        first = bits % (rows // int(NOISE_STEP)) * int(NOISE_STEP)
        signs = [1 - 2 * (bits >> (16 + i) & 1) for i in range(4)]
        sequences = table[:, :, (first + np.arange(sampling.samples)) % rows]
        noise[b, m] = sequences.transpose(2, 0, 1) * signs
    return noise
