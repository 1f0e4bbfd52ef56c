"""How the simulated autopilot obeys rates and attitudes, with the lags and delays of PX4."""

import math

import pytest

from aero_viz.flight.vehicle_model import VehicleModel
from aero_viz.rig.autopilot import PERIOD
from aero_viz.rig.rig import PX4_RESPONSE
from tests.rig.companion import LEVEL

PITCHED = (math.cos(0.1), 0.0, -math.sin(0.1), 0.0)
"""Nose down by 0.2 rad, in PX4's frames."""


def pitch(c):
    """Return by how much the nose is down [rad]."""
    w, _, y, _ = c.autopilot.vehicle.quaternion.numpy()[0]
    return 2.0 * math.atan2(y, w)


def test_thrust_and_rates_respond_with_the_lags_of_px4(make_companion):
    c = make_companion(model=VehicleModel(step=PERIOD, **PX4_RESPONSE))
    c.fly()
    c.run(0.072, rates=(0.0, -1.0, 0.0), thrust=0.6)
    thrust, _, rate, _ = c.autopilot.vehicle.control.numpy()[0]
    # After a time constant 63 % of a change have happened.
    assert rate == pytest.approx(1.0 - math.exp(-0.072 / 0.07), abs=0.03)
    assert thrust / 9.81 == pytest.approx(1.2 - 0.2 * math.exp(-0.072 / 0.045), abs=0.02)


def test_an_attitude_alone_is_obeyed_late_and_the_old_rates_last_until_then(make_companion):
    c = make_companion(model=VehicleModel(step=PERIOD, **PX4_RESPONSE))
    c.fly(0.1, rates=(0.0, -1.0, 0.0))
    before = pitch(c)
    c.run(0.38, mask=7, attitude=LEVEL)
    # The vehicle goes on turning at 1 rad/s although it is told to be level.
    assert pitch(c) - before == pytest.approx(0.4, abs=0.05)
    c.run(1.5, mask=7, attitude=LEVEL)
    assert abs(pitch(c)) < 0.01


def test_attitude_with_rates_follows_the_rates_until_the_attitude_is_obeyed(make_companion):
    c = make_companion(model=VehicleModel(step=PERIOD, **PX4_RESPONSE))
    c.fly(0.1, rates=(0.0, 0.0, 0.0))
    c.run(0.38, mask=0, attitude=PITCHED, rates=(0.0, 0.5, 0.0))
    assert pitch(c) < -0.1
    c.run(1.5, mask=0, attitude=PITCHED, rates=(0.0, 0.5, 0.0))
    assert pitch(c) == pytest.approx(0.2, abs=0.01)
    # Back to rates: the attitude lasts for another 0.4 s.
    c.run(0.38, rates=(0.0, 0.5, 0.0))
    assert pitch(c) == pytest.approx(0.2, abs=0.01)
    c.run(0.5, rates=(0.0, 0.5, 0.0))
    assert pitch(c) < 0.1


def test_a_change_that_is_taken_back_in_time_has_no_effect(make_companion):
    c = make_companion(model=VehicleModel(step=PERIOD, **PX4_RESPONSE))
    c.fly(0.1)
    c.run(0.3, mask=0, attitude=PITCHED)
    c.run(0.1)
    c.run(0.3, mask=0, attitude=PITCHED)
    assert abs(pitch(c)) < 1e-3


def test_attitudes_are_reached_with_bounded_rates(make_companion):
    c = make_companion(model=VehicleModel(step=PERIOD, rate_xy_max=20.0))
    half = 0.5 * math.radians(80.0)
    c.run(1.1, mask=0, attitude=LEVEL)
    c.autopilot.arm()
    assert c.autopilot.engage()  # begins with the attitude
    c.run(0.1, mask=0, attitude=(math.cos(half), 0.0, -math.sin(half), 0.0))
    assert pitch(c) == pytest.approx(0.1 * math.radians(220.0), rel=0.1)
