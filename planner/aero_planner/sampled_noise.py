"""The noise that a planner samples, for another planner that is to plan with the same samples."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from aero_planner.kernels.mppi import NOISE_STEP, random_sign

if TYPE_CHECKING:
    from aero_planner.planner import Planner

wp.set_module_options({"enable_backward": False})


@wp.kernel
def draw_noise(
    seed: wp.array(dtype=int),
    tick: wp.array(dtype=int),
    table: wp.array3d(dtype=float),
    noise: wp.array4d(dtype=wp.vec4),
):
    """Write what `kernels.mppi.sample_rollouts` draws from its table. Launched over [B, M, K].

    The samples of an instance use consecutive rows from a random multiple of NOISE_STEP on, with random signs.
    """
    b, m, k = wp.tid()
    bits = int(wp.rand_init(seed[b] + 7919 * tick[b], m) & wp.uint32(0x7FFFFFFF))
    rows = table.shape[2]
    row = (bits % (rows // NOISE_STEP) * NOISE_STEP + k) % rows
    for t in range(noise.shape[3]):
        e = wp.vec4(0.0, 0.0, 0.0, 0.0)
        for i in range(4):
            e[i] = table[t, i, row] * random_sign(bits, 16 + i)
        noise[b, m, k, t] = e


def noise_of_next_plan(planner: Planner[Any]) -> NDArray[np.float32]:
    """Return the white noise of unit variance with which a planner samples next, shape [B, M, K, N, 4]."""
    work, sampling = planner.workspace, planner.config.sampling
    shape = work.seed.shape[0], len(planner.config.kinds), sampling.samples, sampling.steps
    vec4: Any = wp.vec4
    noise = wp.empty(shape, dtype=vec4, device=planner.device)
    inputs = [work.seed, work.tick, work.noise]
    wp.launch(draw_noise, shape[:3], inputs=inputs, outputs=[noise], device=planner.device)
    values: Any = noise.numpy()
    return values
