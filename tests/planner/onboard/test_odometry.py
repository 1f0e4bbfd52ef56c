"""An odometry of ROS 2 in place of the autopilot's own position."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from aero_planner.onboard.host_clock import HostClock
from aero_planner.onboard.interfaces import VehicleSample
from aero_planner.onboard.odometry import RosOdometry
from aero_planner.onboard.settings import StateSettings
from aero_planner.plan import VehicleState
from aero_planner.quaternions import quaternion_from_angles, rotate
from tests.planner.onboard.ros_driver import AHEAD, LEVEL, odometry_message


class Flight:
    """An odometry, and the samples of an autopilot."""

    def __init__(self, *, mount: Any = LEVEL, ahead: float | None = None, delay: float = 0.0, **settings: Any) -> None:
        self.time, self.delay = 10.0, delay
        date = None if ahead is None else lambda: self.time + ahead
        self.odometry = RosOdometry(StateSettings(**settings), mount, HostClock(), lambda: self.time, date=date)

    def step(
        self, position: Any, *, period: float = 0.1, own: Any = None, own_attitude: Any = LEVEL[1], **of: Any
    ) -> Any:
        """Let a message arrive, and return the autopilot's sample with its state."""
        self.time += period
        self.odometry.receive(odometry_message(self.time - self.delay, position, **of))
        place = np.asarray(position if own is None else own)
        state = VehicleState(place, np.zeros(3), own_attitude, time=self.time)
        sample = VehicleSample(self.time, state, True, True, self.time, in_air=True, position_std=7.0)
        return self.odometry.place(sample)


def test_before_it_arrives_nothing_is_known():
    flight = Flight()
    assert flight.odometry.place(None) is None
    assert flight.step([0, 0, 1]) is None and flight.step([0, 0, 1]) is None
    sample = flight.step([0, 0, 1], variance=0.04)
    assert sample.armed and sample.in_air and sample.time == pytest.approx(flight.time)
    assert sample.position_std == pytest.approx(0.2)  # not that of the autopilot
    assert flight.odometry.place(None) is None


@pytest.mark.parametrize("period", [0.1, 0.02])
def test_its_velocity_is_that_of_its_positions(period: float):
    flight, noise = Flight(), np.random.default_rng(3)
    times = period * np.arange(30)
    positions = np.stack((2.0 * times + times**2, -times, 1.5 + 0.0 * times), axis=1) + 1e-3 * noise.normal(
        size=(30, 3)
    )
    sample = [flight.step(position, period=period) for position in positions][-1]
    np.testing.assert_allclose(sample.state.velocity, [2.0 + 2.0 * times[-1], -1.0, 0.0], atol=0.1)
    assert 0.005 < sample.velocity_std < 0.1 if period < 0.1 else np.isnan(sample.velocity_std)


def test_a_twist_is_in_the_frame_of_the_body_or_of_the_world():
    attitude = quaternion_from_angles(0.0, 20.0, 70.0)
    for kind, expected in (("body", rotate(attitude, [1.0, 0.0, 0.0])), ("world", [1.0, 0.0, 0.0])):
        flight = Flight(velocity=kind, pose="body")
        sample = flight.step([0, 0, 1], attitude=attitude, own_attitude=attitude, linear=(1.0, 0.0, 0.0), variance=0.01)
        np.testing.assert_allclose(sample.state.velocity, expected, atol=1e-12)
        assert sample.velocity_std == pytest.approx(0.1)


def test_its_frame_may_be_turned_about_the_vertical():
    east = quaternion_from_angles(0.0, 0.0, -90.0)
    for kind in ("body", "world"):
        flight = Flight(pose="body", velocity=kind, yaw=-90.0)
        sample = flight.step([3.0, 1.0, 2.0], own=[1.0, -3.0, 2.0], own_attitude=east, linear=(0.5, 0.0, 0.0))
        np.testing.assert_allclose(sample.state.position, [1.0, -3.0, 2.0], atol=1e-12)
        np.testing.assert_allclose(sample.state.velocity, [0.0, -0.5, 0.0], atol=1e-12)
        np.testing.assert_allclose(sample.state.quaternion, east, atol=1e-12)


def test_an_empty_twist_is_refused_while_it_moves():
    flight = Flight(velocity="body")
    sample = [flight.step([0.3 * tick, 0.0, 1.0]) for tick in range(5)][-1]
    assert sample.time < flight.time
    assert any("set state.velocity to positions" in reason for reason in flight.odometry.dropped)


def test_the_pose_of_the_sensor_is_moved_to_the_body():
    mount = np.array([0.1, 0.0, 0.05]), quaternion_from_angles(180.0, 0.0, 0.0)  # upside down
    flight = Flight(mount=mount)
    turned = quaternion_from_angles(0.0, 0.0, 90.0)
    # At the start the sensor is the origin of its odometry. The body turns left, which the sensor sees as right.
    right = quaternion_from_angles(0.0, 0.0, -90.0)
    sensor = rotate(turned, mount[0]) - mount[0] + (1.0, 2.0, 3.0)
    given: Any = {"own": [1.0, 2.0, 3.0], "attitude": right, "own_attitude": turned}
    sample = [flight.step(sensor * (1, -1, -1), **given) for _ in range(3)][-1]
    np.testing.assert_allclose(sample.state.position, [1.0, 2.0, 3.0], atol=1e-9)
    assert abs(np.dot(sample.state.quaternion, turned)) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"own": [3.0, 0.0, 1.0]}, "more than 2 m from the autopilot's own position"),
        ({"own_attitude": quaternion_from_angles(0.0, 0.0, 20.0)}, "turned by more than 15 deg"),
        ({"attitude": (0.0, 0.0, 0.0, 0.0)}, "not finite"),
        ({"linear": (math.nan, 0.0, 0.0)}, "not finite"),
    ],
)
def test_what_contradicts_the_autopilot_or_is_garbage_grows_old(options: dict[str, Any], text: str):
    flight = Flight()
    good = [flight.step([0, 0, 1]) for _ in range(3)][-1]
    later = flight.step([0, 0, 1], **options)
    assert later.time == good.time < flight.time and later.heartbeat_time == flight.time  # the modes stay new
    (reason,) = flight.odometry.dropped
    assert text in reason and reason.startswith("/Odometry ")


def test_a_jump_is_a_reset_and_a_fast_flight_is_none():
    flight = Flight()
    assert [flight.step([0.9 * tick, 0.0, 1.0]) for tick in range(20)][-1].resets == 0
    sample = [flight.step([0.9 * tick, 9.0, 1.0]) for tick in range(4)][-1]
    assert sample.resets == 1 and sample.state.velocity[0] == pytest.approx(9.0)


def test_stamps_count_by_the_clock_of_this_computer():
    flight = Flight()
    sample = [flight.step([0, 0, 1]) for _ in range(4)][-1]
    flight.time += 0.3
    later = flight.odometry.place(sample)
    assert later is not None and later.time == pytest.approx(flight.time - 0.3)


@pytest.mark.parametrize(("ahead", "age"), [(None, 0.0), (AHEAD, 0.04)])
def test_the_date_shows_a_delay_that_an_offset_of_clocks_hides(ahead: float | None, age: float):
    flight = Flight(ahead=ahead, delay=0.04)
    sample = [flight.step([0, 0, 1]) for _ in range(4)][-1]
    assert flight.time - sample.time == pytest.approx(age)


def test_stamps_of_another_clock_are_refused_where_the_date_is_needed():
    flight = Flight(ahead=AHEAD + 5.0)
    assert [flight.step([0, 0, 1]) for _ in range(4)][-1] is None
    assert list(flight.odometry.dropped) == [
        "/Odometry with stamps of another clock than this computer's, which hides its delay"
    ]
