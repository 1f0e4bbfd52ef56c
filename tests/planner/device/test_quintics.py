"""Quintic polynomials against the solution of their boundary conditions."""

import numpy as np
import pytest
import warp as wp

from aero_planner.device.quintics import force_at, guide_force, guide_position, quintic
from tests.planner import reference
from tests.planner.cases import exact


@wp.kernel
def follow(
    boundary: wp.array(dtype=wp.vec3),
    T: float,
    g: wp.vec3,
    drag: float,
    times: wp.array(dtype=float),
    out: wp.array2d(dtype=wp.vec3),
):
    t = wp.tid()
    c = quintic(boundary[0], boundary[1], boundary[2], boundary[3], boundary[4], T)
    out[t, 0] = guide_position(c, times[t])
    out[t, 1] = force_at(guide_force(c, g, drag), times[t])


@pytest.mark.parametrize("seed", range(4))
def test_positions_and_forces(device: str, seed: int):
    rng, T, drag = np.random.default_rng(seed), 1.1, 0.3
    boundary, g = exact(rng.normal(size=(5, 3)) * 3.0), exact(rng.normal(size=3) - [0.0, 0.0, 9.81])
    times = np.linspace(0.0, T, 12)
    out = wp.zeros((12, 2), dtype=wp.vec3, device=device)
    inputs = [
        wp.array(boundary, dtype=wp.vec3, device=device), T, wp.vec3(*g), drag,
        wp.array(times.astype(np.float32), dtype=float, device=device),
    ]  # fmt: skip
    wp.launch(follow, 12, inputs=inputs, outputs=[out], device=device)
    k = np.arange(6)
    p0, v0, a0, p1, v1 = boundary
    c = reference.quintic(p0, v0, a0, p1, v1, T)
    velocity = (c[:, 1:] * k[1:]) @ times ** k[:5, None]
    acceleration = (c[:, 2:] * k[2:] * k[1:5]) @ times ** k[:4, None]
    expected = reference.sample_guide(c, times), acceleration.T - g + drag * velocity.T
    for found, values in zip(out.numpy().transpose(1, 0, 2), expected, strict=True):
        np.testing.assert_allclose(found, values, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(out.numpy()[[0, -1], 0], boundary[[0, 3]], atol=1e-4)
