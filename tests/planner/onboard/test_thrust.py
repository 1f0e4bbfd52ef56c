"""The thrust curve against PX4's formula, and its calibration."""

import numpy as np
import pytest

from aero_planner.onboard.thrust import ThrustModel, calibrate_hover_thrust

WEIGHT = 1.6 * 9.81


def test_the_hover_thrust_carries_the_weight():
    for curve in (0.0, 0.3, 1.0):
        model = ThrustModel(mass=1.6, hover_thrust=0.42, curve=curve)
        assert model.force(0.42) == pytest.approx(WEIGHT)
        assert model.signal(WEIGHT) == pytest.approx(0.42)


def test_linear_and_quadratic_curves_by_hand():
    # Linear: half the hover thrust carries half. Square: it carries a quarter.
    assert ThrustModel(mass=1.6, hover_thrust=0.4, curve=0.0).force(0.2) == pytest.approx(0.5 * WEIGHT)
    assert ThrustModel(mass=1.6, hover_thrust=0.4, curve=1.0).force(0.2) == pytest.approx(0.25 * WEIGHT)
    # c = 0.5: F(s) ~ 0.5 s + 0.5 s^2; F(0.8) / F(0.4) = (0.4 + 0.32) / (0.2 + 0.08).
    assert ThrustModel(mass=1.6, hover_thrust=0.4, curve=0.5).force(0.8) == pytest.approx(0.72 / 0.28 * WEIGHT)


@pytest.mark.parametrize("curve", [0.0, 1e-9, 0.25, 0.8, 1.0])
def test_signal_and_force_are_inverse(curve):
    model = ThrustModel(mass=1.6, hover_thrust=0.42, curve=curve)
    for signal in np.linspace(0.0, 1.0, 21):
        assert model.signal(model.force(signal)) == pytest.approx(signal, abs=1e-12)


def test_signal_stays_in_its_range():
    assert ThrustModel(mass=1.0, hover_thrust=0.5).signal(-3.0) == 0.0
    assert ThrustModel(mass=1.0, hover_thrust=0.5, curve=0.4).signal(1e6) == 1.0


@pytest.mark.parametrize("curve", [0.0, 0.35, 1.0])
def test_calibration_finds_the_hover_thrust_of_a_noisy_log(curve):
    random = np.random.default_rng(2)
    signals = random.uniform(0.3, 0.6, size=2000)
    forces = np.array([ThrustModel(mass=1.6, hover_thrust=0.47, curve=curve).force(s) for s in signals])
    measured = forces / 1.6 + random.normal(scale=0.5, size=2000)
    assert calibrate_hover_thrust(signals, measured, curve=curve) == pytest.approx(0.47, abs=2e-3)


@pytest.mark.parametrize(
    ("signals", "accelerations"),
    [([], []), ([0.5], [9.8, 9.8]), ([0.5, np.nan], [9.8, 9.8]), ([0.0, 0.0], [9.8, 9.8]), ([0.5], [-9.8])],
)
def test_calibration_refuses_logs_without_a_hover(signals, accelerations):
    with pytest.raises(ValueError, match="the log"):
        calibrate_hover_thrust(signals, accelerations)
