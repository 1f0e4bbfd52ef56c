"""Conversions between MAVLink's frames and the planner's, against hand-worked cases and rotation matrices."""

import math

import numpy as np
import pytest

from aero_planner import quaternions
from aero_planner.onboard import frames
from tests.planner.reference import rotation

HALF = math.sqrt(0.5)


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


def test_attitude_conversion_is_a_change_of_basis_on_both_sides():
    # v_NED = R v_FRD, so v_NWU = D R D v_FLU with D the half turn about x.
    turn = np.diag([1.0, -1.0, -1.0])
    for q in np.random.default_rng(0).normal(size=(20, 4)):
        q /= np.linalg.norm(q)
        np.testing.assert_allclose(rotation(frames.attitude_from_ned(q)), turn @ rotation(q) @ turn, atol=1e-12)
