"""Smoothing of noisy poses on a motion that is known exactly."""

import numpy as np
import pytest

from aero_planner.quaternions import conjugate, multiply, quaternion_from_angles, rotate, rotation_vector
from aero_viz.recordings.imu import ImuSamples
from aero_viz.recordings.imu_smoothing import smooth_motion
from aero_viz.recordings.transforms import IDENTITY

START = 1_700_000_000_000_000_000
Noisy = tuple[np.ndarray, np.ndarray, np.ndarray]


def motion(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and attitudes of a slalom at 5 m/s."""
    positions = np.stack([5.0 * times, np.sin(1.5 * times), 0.3 * np.cos(times)], axis=1)
    attitudes = np.array([quaternion_from_angles(20.0 * np.sin(2.0 * t), 10.0, 30.0 * np.cos(t)) for t in times])
    return positions, attitudes


def measure(times: np.ndarray, *, rate_bias: float = 0.005) -> ImuSamples:
    """Return the slalom as an IMU with constant biases measures it, that of its rates in [rad/s]."""
    _, attitudes = motion(times)
    step = 1e-3
    before, after = motion(times - step), motion(times + step)
    force = (before[0] - 2.0 * motion(times)[0] + after[0]) / step**2 + [0.0, 0.0, 9.81]
    rates = rotation_vector(multiply(conjugate(before[1]), after[1])) / (2.0 * step)
    stamps = START + np.round(1e9 * times).astype(np.int64)
    return ImuSamples("/imu", "imu", stamps, rotate(conjugate(attitudes), force) + 0.05, rates + rate_bias)


@pytest.fixture(scope="module")
def imu() -> ImuSamples:
    return measure(np.arange(-0.1, 6.1, 0.005))


@pytest.fixture(scope="module")
def noisy() -> Noisy:
    """Times, positions and attitudes at 10 Hz, with the noise of a registration."""
    times, random = np.arange(0.0, 6.0, 0.1), np.random.default_rng(1)
    positions, attitudes = motion(times)
    noise = np.array([quaternion_from_angles(*angles) for angles in random.normal(0.0, 0.9, (len(times), 3))])
    return times, positions + random.normal(0.0, 0.03, positions.shape), multiply(attitudes, noise)


def errors(times: np.ndarray, positions: np.ndarray, attitudes: np.ndarray) -> tuple[float, float]:
    """Return the root mean square errors [m], [deg]."""
    true = motion(times)
    turn = rotation_vector(multiply(conjugate(true[1]), attitudes))
    squares = ((positions - true[0]) ** 2).sum(axis=1), (turn**2).sum(axis=1)
    return float(np.sqrt(squares[0].mean())), float(np.degrees(np.sqrt(squares[1].mean())))


def test_the_noise_of_the_poses_falls_and_the_motion_stays(imu: ImuSamples, noisy: Noisy):
    raw = errors(*noisy)
    positions, attitudes = smooth_motion(*noisy, imu, IDENTITY, START)
    smooth = errors(noisy[0], positions, attitudes)
    assert smooth[0] < 0.6 * raw[0] and smooth[1] < 0.5 * raw[1]


def test_a_bias_may_add_up_to_more_than_half_a_turn():
    times = np.arange(0.0, 20.0, 0.1)
    biased = measure(np.arange(-0.1, 20.1, 0.01), rate_bias=0.2)  # 4 rad about each axis in the end
    smooth = smooth_motion(times, *motion(times), biased, IDENTITY, START)
    distance, angle = errors(times, *smooth)
    assert distance < 0.02 and angle < 1.0


@pytest.mark.parametrize("kept", [slice(600), slice(100, None), np.r_[0:300, 400:1240]])
def test_an_imu_with_gaps_changes_nothing(imu: ImuSamples, noisy: Noisy, kept: slice):
    cut = imu._replace(times=imu.times[kept], forces=imu.forces[kept], rates=imu.rates[kept])
    positions, attitudes = smooth_motion(*noisy, cut, IDENTITY, START)
    assert positions is noisy[1] and attitudes is noisy[2]
