"""What a watchdog decides; `test_node` flies with it, `test_failsafe_process` runs it in a process of its own."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from aero_planner import PlannerConfig
from aero_planner.onboard.dead_reckoning import MotionState, StopController, propagate
from aero_planner.onboard.settings import BrakeSettings
from aero_planner.onboard.watchdog import Heartbeat, Watchdog
from aero_planner.quaternions import quaternion_from_angles, rotate

PERIOD, DEADLINE, BLIND_TIME = 0.02, 0.1, 1.5
VEHICLE = PlannerConfig().vehicle
HOVER = np.array([9.81, 0.0, 0.0, 0.0])
TURNING = np.array([12.0, 0.5, -0.3, 0.0])
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


class Sent:
    """A link that keeps what is sent."""

    def __init__(self) -> None:
        self.commands: list[NDArray[np.float64]] = []

    def send(self, command: ArrayLike) -> None:
        self.commands.append(np.array(command))


@pytest.fixture
def link() -> Sent:
    return Sent()


@pytest.fixture
def watchdog(link: Sent) -> Watchdog:
    stop = StopController(VEHICLE, BrakeSettings())
    return Watchdog(link, stop, VEHICLE, period=PERIOD, deadline=DEADLINE, blind_time=BLIND_TIME)


def moving(time: float) -> MotionState:
    return MotionState(time, np.zeros(3), np.array([4.0, 0.0, 0.0]), LEVEL)


def tilt(motion: MotionState | None) -> float:
    """Return the angle between the drone's axis and the vertical [deg]."""
    assert motion is not None
    return math.degrees(math.acos(min(1.0, float(rotate(motion.quaternion, [0.0, 0.0, 1.0])[2]))))


def times(begin: float, end: float) -> NDArray[np.float64]:
    """Return when the watchdog looks: once per period, from `begin` to before `end` [s]."""
    return np.arange(begin, end - 1e-9, PERIOD)


def test_it_brakes_by_dead_reckoning_for_its_time_then_hovers_and_is_silent(watchdog: Watchdog, link: Sent):
    watchdog.beat(Heartbeat(10.0, moving(10.0), TURNING))
    done = [(now, watchdog.check(now)) for now in times(10.01, 13.0)]
    acted = [(now, beat) for now, beat in done if beat is not None]
    assert DEADLINE < acted[0][0] - 10.0 <= DEADLINE + PERIOD
    assert DEADLINE + BLIND_TIME < acted[-1][0] - 10.0 <= DEADLINE + BLIND_TIME + PERIOD
    np.testing.assert_allclose(np.diff([now for now, _ in acted]), PERIOD)
    # From where TURNING has brought the drone, what was sent brings it to the next place, and so on.
    motion, command, sent = moving(10.0), TURNING, iter(link.commands)
    for now, beat in acted[:-1]:
        motion = propagate(motion, command, now, VEHICLE)
        assert beat.motion is not None and beat.command is not None
        np.testing.assert_allclose(beat.motion.velocity, motion.velocity, atol=1e-9)
        command = beat.command
        np.testing.assert_array_equal(command, next(sent))
    assert motion.speed < 0.3 and tilt(motion) < 0.5
    # To those who are told of it, nobody obeys from then on.
    np.testing.assert_allclose(link.commands[-1], HOVER)
    assert acted[-1][1].command is None and len(link.commands) == len(acted)
    assert watchdog.interventions == 1 and watchdog.braking and not watchdog.needed


def test_until_its_deadline_it_goes_on_with_the_plan(watchdog: Watchdog, link: Sent):
    ahead = np.array([[11.0 + k, 0.1 * k, 0.0, 0.0] for k in range(3)])
    watchdog.beat(Heartbeat(10.0, moving(10.0), TURNING, ahead))
    said = [(now, watchdog.check(now)) for now in times(10.005, 10.2)]
    # Nothing while the tick may still come; then what the plan says for that time, as far as it reaches; then to brake.
    assert [beat is not None for _, beat in said[:2]] == [False, False]
    np.testing.assert_allclose(link.commands[:2], ahead[1:])
    assert said[3][1] is not None and said[4][1] is None and said[5][1] is not None
    assert said[5][0] - 10.0 > DEADLINE and watchdog.interventions == 1
    # The drone has obeyed the beat's command, then those, and has been told nothing else since.
    motion = moving(10.0)
    for command, end in ((TURNING, 10.045), (ahead[1], 10.065), (ahead[2], 10.105)):
        motion = propagate(motion, command, end, VEHICLE)
    assert said[5][1].motion is not None
    np.testing.assert_allclose(said[5][1].motion.quaternion, motion.quaternion, atol=1e-9)


def test_a_loop_that_is_given_up_is_braked_even_before_a_tick_is_late(watchdog: Watchdog, link: Sent):
    watchdog.beat(Heartbeat(10.0, moving(10.0), HOVER, np.tile(HOVER, (3, 1))))
    assert watchdog.check(10.004) is None
    watchdog.give_up(10.005)
    assert watchdog.check(10.005) is not None
    assert link.commands[0][2] < -1.0  # nose up


def test_a_loop_that_goes_on_is_left_alone(watchdog: Watchdog, link: Sent):
    for now in times(10.0, 11.0):
        watchdog.beat(Heartbeat(now, moving(now), HOVER))
        assert watchdog.check(now + 0.5 * PERIOD) is None
    assert watchdog.needed and not watchdog.braking and not link.commands


def test_a_loop_that_comes_back_is_left_alone_and_replaced_again(watchdog: Watchdog, link: Sent):
    watchdog.beat(Heartbeat(10.0, moving(10.0), HOVER))
    for now in times(10.0, 10.2):
        watchdog.check(now)
    count = len(link.commands)
    assert count > 0
    watchdog.beat(Heartbeat(10.2, moving(10.2), HOVER))
    for now in times(10.2, 10.28):
        assert watchdog.check(now) is None
    assert len(link.commands) == count
    for now in times(10.28, 10.4):
        watchdog.check(now)
    assert len(link.commands) > count and watchdog.interventions == 2


@pytest.mark.parametrize("blind_time", [0.4, 0.6, 0.8])
def test_however_short_its_time_is_it_ends_level(link: Sent, blind_time: float):
    stop = StopController(VEHICLE, BrakeSettings())
    watchdog = Watchdog(link, stop, VEHICLE, period=PERIOD, deadline=DEADLINE, blind_time=blind_time)
    tilted = MotionState(10.0, np.zeros(3), np.array([4.0, 0.0, 0.0]), quaternion_from_angles(10.0, 20.0, 30.0))
    watchdog.beat(Heartbeat(10.0, tilted, TURNING))
    motions = [beat.motion for now in times(10.01, 11.5) if (beat := watchdog.check(now)) is not None]
    # The last command is to hover without turning: on a drone that is tilted it would not be to hover.
    assert tilt(motions[0]) > 15.0 and tilt(motions[-2]) < 2.0
    np.testing.assert_allclose(link.commands[-1], HOVER)


@pytest.mark.parametrize(("motion", "command"), [(None, HOVER), (moving(10.0), None), (None, None)])
def test_where_the_drone_does_not_obey_it_is_silent(watchdog: Watchdog, link: Sent, motion, command):
    watchdog.beat(Heartbeat(10.0, motion, command))
    for now in times(10.0, 12.0):
        assert watchdog.check(now) is None
    assert not watchdog.needed and not link.commands


def test_what_stood_still_for_too_long_says_nothing(watchdog: Watchdog, link: Sent):
    watchdog.beat(Heartbeat(10.0, moving(10.0), HOVER))
    assert watchdog.check(10.01) is None
    for now in times(12.0, 12.2):
        assert watchdog.check(now) is None
    assert not watchdog.needed and not link.commands


def test_given_up_the_loop_is_replaced_at_once(watchdog: Watchdog, link: Sent):
    watchdog.beat(Heartbeat(10.0, moving(10.0), HOVER))
    assert watchdog.check(10.01) is None
    acted = []
    for now in times(10.012, 12.0):
        watchdog.give_up(now)
        if watchdog.check(now) is not None:
            acted.append(now)
    assert acted[0] == 10.012 and BLIND_TIME < acted[-1] - acted[0] <= BLIND_TIME + PERIOD
    np.testing.assert_allclose(link.commands[-1], HOVER)


def test_given_up_while_it_is_replaced_it_is_replaced_for_the_same_time(watchdog: Watchdog):
    watchdog.beat(Heartbeat(10.0, moving(10.0), HOVER))
    acted = []
    for now in times(10.0, 13.0):
        if now > 11.4:
            watchdog.give_up(now)
        if watchdog.check(now) is not None:
            acted.append(now)
    assert BLIND_TIME < acted[-1] - acted[0] + PERIOD <= BLIND_TIME + 2 * PERIOD
