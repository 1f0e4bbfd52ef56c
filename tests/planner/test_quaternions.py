"""Quaternions and rigid transforms against rotation matrices built from the definition q v q*."""

import math

import numpy as np
import pytest

from aero_planner.quaternions import (
    compose_transforms,
    conjugate,
    integrate_rates,
    invert_transform,
    multiply,
    quaternion_from_angles,
    rotate,
    rotation_matrix,
    rotation_vector,
    slerp,
)


def matrix(q):
    """R(q) from the definition q v q*, column by column."""
    w, u = q[0], np.asarray(q[1:])

    def rotated(v):
        return (w * w - u @ u) * v + 2.0 * (u @ v) * u + 2.0 * w * np.cross(u, v)

    return np.column_stack([rotated(axis) for axis in np.eye(3)])


def unit_quaternions(count, seed):
    q = np.random.default_rng(seed).normal(size=(count, 4))
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def test_rotate_and_multiply_are_matrix_products():
    random = np.random.default_rng(1)
    a, b = (q / np.linalg.norm(q) for q in random.normal(size=(2, 4)))
    v = random.normal(size=(7, 3))
    np.testing.assert_allclose(rotate(a, v), v @ matrix(a).T, atol=1e-12)
    np.testing.assert_allclose(matrix(multiply(a, b)), matrix(a) @ matrix(b), atol=1e-12)


def test_integrated_rates_turn_about_the_body_axis():
    start = quaternion_from_angles(0.0, 0.0, 90.0)
    # 1 rad/s about the body's y axis, which points to -x: after half a second the nose has gone down by 0.5 rad.
    q = integrate_rates(start, [0.0, 1.0, 0.0], 0.5)
    nose = [0.0, math.cos(0.5), -math.sin(0.5)]
    np.testing.assert_allclose(rotate(q, [1.0, 0.0, 0.0]), nose, atol=1e-12)
    np.testing.assert_allclose(integrate_rates(q, [0.0, 1.0, 0.0], -0.5), start, atol=1e-12)
    np.testing.assert_allclose(integrate_rates(start, [0.0, 0.0, 0.0], 3.0), start)


def test_mount_angles_are_yaw_after_pitch_after_roll():
    r, p, y = np.radians([20.0, -35.0, 120.0])
    c, s = np.cos, np.sin
    about_x = np.array([[1, 0, 0], [0, c(r), -s(r)], [0, s(r), c(r)]])
    about_y = np.array([[c(p), 0, s(p)], [0, 1, 0], [-s(p), 0, c(p)]])
    about_z = np.array([[c(y), -s(y), 0], [s(y), c(y), 0], [0, 0, 1]])
    q = quaternion_from_angles(20.0, -35.0, 120.0)
    np.testing.assert_allclose(matrix(q), about_z @ about_y @ about_x, atol=1e-12)


def test_rotation_matrices_match_the_definition_for_any_leading_shape():
    q = unit_quaternions(6, seed=2)
    np.testing.assert_allclose(rotation_matrix(q), [matrix(row) for row in q], atol=1e-12)
    np.testing.assert_array_equal(rotation_matrix(q.reshape(2, 3, 4)), rotation_matrix(q).reshape(2, 3, 3, 3))
    np.testing.assert_array_equal(rotation_matrix(q[0]), rotation_matrix(q)[0])


def test_the_conjugate_undoes_a_rotation():
    q, v = unit_quaternions(5, seed=3), np.random.default_rng(4).normal(size=(5, 3))
    np.testing.assert_allclose(rotate(conjugate(q), rotate(q, v)), v, atol=1e-12)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_slerp_turns_in_proportion_to_the_fraction(sign):
    a = quaternion_from_angles(10.0, 20.0, 30.0)
    b = multiply(quaternion_from_angles(0.0, 0.0, 80.0), a)
    fractions = np.array([0.0, 0.25, 1.0])
    expected = [multiply(quaternion_from_angles(0.0, 0.0, angle), a) for angle in (0.0, 20.0, 80.0)]
    result = slerp(a, sign * b, fractions)
    np.testing.assert_allclose(result, expected, atol=1e-12)
    np.testing.assert_array_equal(slerp(a, sign * b, 0.25), result[1])


def test_slerp_between_equal_attitudes_stays_there():
    q = unit_quaternions(1, seed=5)[0]
    np.testing.assert_allclose(slerp(q, q, [0.0, 0.5, 1.0]), np.tile(q, (3, 1)), atol=1e-12)


def test_composed_transforms_apply_one_after_the_other():
    (p, p2, x), (q, q2) = np.random.default_rng(6).normal(size=(3, 3)), unit_quaternions(2, seed=7)
    position, quaternion = compose_transforms(p, q, p2, q2)
    np.testing.assert_allclose(rotate(quaternion, x) + position, rotate(q, rotate(q2, x) + p2) + p, atol=1e-12)
    position, quaternion = compose_transforms(*invert_transform(p, q), p, q)
    np.testing.assert_allclose(position, 0.0, atol=1e-12)
    np.testing.assert_allclose(quaternion, [1.0, 0.0, 0.0, 0.0], atol=1e-12)


def test_the_rotation_vector_inverts_the_integration_of_rates():
    rates = np.array([0.3, -1.2, 0.5])
    turned = integrate_rates([1.0, 0.0, 0.0, 0.0], rates, 1.0)
    np.testing.assert_allclose(rotation_vector(turned), rates, atol=1e-12)
    np.testing.assert_allclose(rotation_vector(-turned), rates, atol=1e-12)
    np.testing.assert_allclose(rotation_vector([1.0, 0.0, 0.0, 0.0]), 0.0)
