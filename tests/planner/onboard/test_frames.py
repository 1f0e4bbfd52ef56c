"""Conversions between MAVLink's frames and ours, against cases worked by hand and rotation matrices."""

from __future__ import annotations

import math

import numpy as np
import pytest

from aero_planner import quaternions
from aero_planner.onboard import frames

HALF = math.sqrt(0.5)


def matrix(q):
    """R(q) from the definition q v q*, column by column."""
    w, u = q[0], np.asarray(q[1:])

    def turned(v):
        return (w * w - u @ u) * v + 2.0 * (u @ v) * u + 2.0 * w * np.cross(u, v)

    return np.column_stack([turned(axis) for axis in np.eye(3)])


def test_vectors_by_hand():
    # 1 m north, 2 m east, 3 m below the origin: x forward (north), y left (west), z up.
    assert frames.world_from_ned([1.0, 2.0, 3.0]).tolist() == [1.0, -2.0, -3.0]
    assert frames.ned_from_world([1.0, -2.0, -3.0]).tolist() == [1.0, 2.0, 3.0]
    # Rolling right is positive in both; nose up is positive in FRD, nose down in FLU; right turn positive in FRD.
    assert frames.flu_from_frd([0.1, 0.2, 0.3]).tolist() == [0.1, -0.2, -0.3]
    assert frames.frd_from_flu([0.1, -0.2, -0.3]).tolist() == [0.1, 0.2, 0.3]


@pytest.mark.parametrize(
    ("ned", "nose", "up"),
    [
        ([1.0, 0.0, 0.0, 0.0], [1, 0, 0], [0, 0, 1]),  # level, nose to the north
        ([HALF, 0.0, 0.0, HALF], [0, -1, 0], [0, 0, 1]),  # heading 90 deg: nose to the east, which is -y
        ([HALF, 0.0, HALF, 0.0], [0, 0, 1], [-1, 0, 0]),  # pitch 90 deg: nose up, top to the south
        ([HALF, HALF, 0.0, 0.0], [1, 0, 0], [0, -1, 0]),  # roll 90 deg: right wing down, top to the east
    ],
)
def test_attitudes_by_hand(ned, nose, up):
    q = frames.attitude_from_ned(ned)
    np.testing.assert_allclose(quaternions.rotate(q, [1.0, 0.0, 0.0]), nose, atol=1e-12)
    np.testing.assert_allclose(quaternions.rotate(q, [0.0, 0.0, 1.0]), up, atol=1e-12)
    np.testing.assert_allclose(frames.attitude_to_ned(q), ned)


def test_attitude_is_the_matrix_seen_from_the_other_frames():
    # v_NED = R v_FRD and both sides turned: v_NWU = D R D v_FLU.
    turn = np.diag([1.0, -1.0, -1.0])
    for q in np.random.default_rng(0).normal(size=(20, 4)):
        q /= np.linalg.norm(q)
        np.testing.assert_allclose(matrix(frames.attitude_from_ned(q)), turn @ matrix(q) @ turn, atol=1e-12)


def test_rotate_and_multiply_are_matrix_products():
    random = np.random.default_rng(1)
    a, b = (q / np.linalg.norm(q) for q in random.normal(size=(2, 4)))
    v = random.normal(size=(7, 3))
    np.testing.assert_allclose(quaternions.rotate(a, v), v @ matrix(a).T, atol=1e-12)
    np.testing.assert_allclose(matrix(quaternions.multiply(a, b)), matrix(a) @ matrix(b), atol=1e-12)


def test_advance_turns_about_the_body_axis():
    start = quaternions.quaternion_from_angles(0.0, 0.0, 90.0)
    # 1 rad/s about the body's y axis, which points to -x: after half a second the nose has gone down by 0.5 rad.
    q = quaternions.advance(start, [0.0, 1.0, 0.0], 0.5)
    nose = [0.0, math.cos(0.5), -math.sin(0.5)]
    np.testing.assert_allclose(quaternions.rotate(q, [1.0, 0.0, 0.0]), nose, atol=1e-12)
    np.testing.assert_allclose(quaternions.advance(q, [0.0, 1.0, 0.0], -0.5), start, atol=1e-12)
    np.testing.assert_allclose(quaternions.advance(start, [0.0, 0.0, 0.0], 3.0), start)


def test_mount_angles_are_yaw_after_pitch_after_roll():
    r, p, y = np.radians([20.0, -35.0, 120.0])
    c, s = np.cos, np.sin
    about_x = np.array([[1, 0, 0], [0, c(r), -s(r)], [0, s(r), c(r)]])
    about_y = np.array([[c(p), 0, s(p)], [0, 1, 0], [-s(p), 0, c(p)]])
    about_z = np.array([[c(y), -s(y), 0], [s(y), c(y), 0], [0, 0, 1]])
    q = quaternions.quaternion_from_angles(20.0, -35.0, 120.0)
    np.testing.assert_allclose(matrix(q), about_z @ about_y @ about_x, atol=1e-12)
