import numpy as np
import pytest
from numpy.typing import ArrayLike

from aero_planner.onboard.cloud_drift import Drift
from aero_planner.onboard.dead_reckoning import MotionState
from aero_planner.onboard.drift_correction import DriftCorrection

INTERVAL = 0.5


def motion(time: float, position: ArrayLike = (0.0, 0.0, 2.0), velocity: ArrayLike = (0.0, 0.0, 0.0)) -> MotionState:
    return MotionState(time, np.array(position), np.array(velocity), np.array([1.0, 0.0, 0.0, 0.0]))


def drift(velocity: ArrayLike) -> Drift:
    return Drift(0.0, INTERVAL * np.asarray(velocity))


@pytest.fixture
def lost() -> DriftCorrection:
    """A correction whose position is lost at 0 s; at 0.5 s, a drift of 0.2 m/s to the left was measured twice."""
    correction = DriftCorrection()
    correction.apply(motion(0.0), lost=True)
    correction.add(0.3, drift((0.0, 0.2, 0.0)), INTERVAL)
    correction.add(0.5, drift((0.0, 0.2, 0.0)), INTERVAL)
    return correction


def test_a_known_position_is_not_corrected():
    correction = DriftCorrection()
    correction.add(0.0, drift((0.0, 0.2, 0.0)), INTERVAL)
    assert correction.apply(given := motion(0.1), lost=False) is given


def test_the_drift_is_taken_from_velocity_and_position(lost: DriftCorrection):
    lost.apply(motion(0.5), lost=True)
    corrected = lost.apply(motion(1.5, (1.0, 1.0, 2.0), (0.1, 0.1, 0.1)), lost=True)
    np.testing.assert_allclose(corrected.velocity, [0.1, -0.1, 0.1])
    np.testing.assert_allclose(corrected.position, [1.0, 0.7, 2.0])  # 0.2 m/s from the first motion on


def test_a_measured_height_is_not_used(lost: DriftCorrection):
    lost.add(0.6, drift((0.0, 0.2, 0.3)), INTERVAL)
    np.testing.assert_allclose(lost.apply(motion(0.7), lost=True).velocity, [0.0, -0.2, 0.0])


@pytest.mark.parametrize(
    ("newest", "expected"), [((0.1, 0.3, 0.0), 0.2), ((0.1, 0.05, 0.0), 0.05), ((0.1, -0.2, 0.0), 0.0)]
)
def test_of_two_measurements_in_a_row_the_smaller_one_counts(lost: DriftCorrection, newest: ArrayLike, expected: float):
    lost.add(0.7, drift(newest), INTERVAL)
    np.testing.assert_allclose(lost.apply(motion(0.8), lost=True).velocity, [0.0, -expected, 0.0])


@pytest.mark.parametrize("time", [0.5, 3.0])
def test_a_single_measurement_does_not_count(lost: DriftCorrection, time: float):
    if time < 2.0:
        lost.clear()
        lost.apply(motion(0.4), lost=True)
    lost.add(time, drift((0.3, 0.2, 0.0)), INTERVAL)
    np.testing.assert_array_equal(lost.apply(motion(time), lost=True).velocity, 0.0)


def test_an_old_measurement_no_longer_counts(lost: DriftCorrection):
    place = lost.apply(motion(2.4), lost=True).position
    corrected = lost.apply(motion(3.0), lost=True)
    np.testing.assert_array_equal(corrected.velocity, 0.0)
    np.testing.assert_array_equal(corrected.position, place)


@pytest.mark.parametrize("how", ["found again", "estimator reset"])
def test_the_next_loss_starts_from_zero(lost: DriftCorrection, how: str):
    lost.apply(motion(1.0), lost=True)
    if how == "found again":
        lost.apply(motion(1.1), lost=False)
    else:
        lost.clear()
    corrected = lost.apply(motion(1.2), lost=True)
    np.testing.assert_array_equal(corrected.velocity, 0.0)
    np.testing.assert_array_equal(corrected.position, [0.0, 0.0, 2.0])
