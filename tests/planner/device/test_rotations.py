"""Rotations against matrices."""

import numpy as np
import pytest
import warp as wp

from aero_planner.device.rotations import (
    heading,
    near_atan2,
    quat_from_heading,
    quat_inverse_rotate,
    quat_multiply,
    quat_rotate,
    wrap_angle,
)
from tests.planner import reference
from tests.planner.cases import exact, random_quaternion


@wp.kernel
def rotate(
    q: wp.array(dtype=wp.vec4),
    r: wp.array(dtype=wp.vec4),
    x: wp.array(dtype=wp.vec3),
    out: wp.array2d(dtype=wp.vec3),
    product: wp.array(dtype=wp.vec4),
    yaw: wp.array(dtype=float),
):
    i = wp.tid()
    out[i, 0] = quat_rotate(q[i], x[i])
    out[i, 1] = quat_inverse_rotate(q[i], x[i])
    product[i] = quat_multiply(q[i], r[i])
    yaw[i] = heading(q[i])


@wp.kernel
def angles(y: wp.array(dtype=float), x: wp.array(dtype=float), out: wp.array2d(dtype=float)):
    i = wp.tid()
    out[i, 0] = near_atan2(y[i], x[i])
    out[i, 1] = wrap_angle(y[i])
    out[i, 2] = heading(quat_from_heading(y[i]))


@pytest.mark.parametrize("seed", range(3))
def test_rotations_are_those_of_the_matrix(device: str, seed: int):
    rng, n = np.random.default_rng(seed), 50
    q, r = (exact([reference.unit(random_quaternion(rng, 3.0)) for _ in range(n)]) for _ in range(2))
    x = exact(rng.normal(size=(n, 3)))
    arrays = [
        wp.array(values, dtype=dtype, device=device) for values, dtype in ((q, wp.vec4), (r, wp.vec4), (x, wp.vec3))
    ]
    out = wp.zeros((n, 2), dtype=wp.vec3, device=device)
    product, yaw = wp.zeros(n, dtype=wp.vec4, device=device), wp.zeros(n, dtype=float, device=device)
    wp.launch(rotate, n, inputs=arrays, outputs=[out, product, yaw], device=device)
    for i in range(n):
        R = reference.rotation(q[i])
        np.testing.assert_allclose(out.numpy()[i], [R @ x[i], R.T @ x[i]], atol=2e-6)
        np.testing.assert_allclose(product.numpy()[i], reference.quat_multiply(q[i], r[i]), atol=1e-6)
        assert yaw.numpy()[i] == pytest.approx(np.arctan2(R[1, 0], R[0, 0]), abs=1e-4)


def test_angles(device: str):
    rng = np.random.default_rng(0)
    y, x = (np.concatenate((rng.normal(size=500) * 3.0, edges)).astype(np.float32) for edges in (
        [0.0, 0.0, 1.0, -1.0, 1e-20, 1e8], [1.0, -1.0, 0.0, 0.0, 1.0, 1e-8],
    ))  # fmt: skip
    out = wp.zeros((len(y), 3), dtype=float, device=device)
    inputs = [wp.array(values, dtype=float, device=device) for values in (y, x)]
    wp.launch(angles, len(y), inputs=inputs, outputs=[out], device=device)
    found = out.numpy().astype(np.float64)
    np.testing.assert_allclose(found[:, 0], np.arctan2(y, x, dtype=np.float64), atol=5e-7)
    small = np.abs(y) < 100.0
    wrapped = (y.astype(np.float64) + np.pi) % (2.0 * np.pi) - np.pi
    np.testing.assert_allclose(found[small, 1], wrapped[small], atol=2e-6)
    np.testing.assert_allclose(np.sin(found[small, 2]), np.sin(y[small]), atol=2e-6)
    np.testing.assert_allclose(np.cos(found[small, 2]), np.cos(y[small]), atol=2e-6)
