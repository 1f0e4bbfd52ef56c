"""Decisions of the watchdog. `test_node_faults` flies with it; `test_failsafe_process` runs it in a second process."""

import math

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from aero_planner import PlannerConfig
from aero_planner.onboard.dead_reckoning import MotionState, propagate
from aero_planner.onboard.settings import BrakeSettings
from aero_planner.onboard.stop_controller import StopController
from aero_planner.onboard.watchdog import Heartbeat, Watchdog
from aero_planner.quaternions import quaternion_from_angles, rotate
from tests.planner.onboard.simulated import flying_north

PERIOD, DEADLINE, BLIND_TIME = 0.02, 0.1, 1.5
VEHICLE = PlannerConfig().vehicle
HOVER = np.array([9.81, 0.0, 0.0, 0.0])
TURNING = np.array([12.0, 0.5, -0.3, 0.0])
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


class RecordingLink:
    """A link that keeps the commands."""

    def __init__(self) -> None:
        self.commands: list[NDArray[np.float64]] = []

    def send(self, command: ArrayLike, attitude: ArrayLike | None = None) -> None:
        self.commands.append(np.array(command))


@pytest.fixture
def link() -> RecordingLink:
    return RecordingLink()


@pytest.fixture
def watchdog(link: RecordingLink) -> Watchdog:
    stop = StopController(VEHICLE, BrakeSettings())
    return Watchdog(link, stop, VEHICLE, period=PERIOD, deadline=DEADLINE, blind_time=BLIND_TIME)


def tilt(motion: MotionState | None) -> float:
    """Return the angle between the drone's axis and the vertical [deg]."""
    assert motion is not None
    return math.degrees(math.acos(min(1.0, float(rotate(motion.quaternion, [0.0, 0.0, 1.0])[2]))))


def times(begin: float, end: float) -> NDArray[np.float64]:
    """Return the times of the checks [s]: once per period from `begin` on, before `end`."""
    return np.arange(begin, end - 1e-9, PERIOD)


def test_it_brakes_by_dead_reckoning_then_hovers_and_falls_silent(watchdog: Watchdog, link: RecordingLink):
    watchdog.report(Heartbeat(10.0, flying_north(10.0), TURNING))
    checks = [(now, watchdog.check(now)) for now in times(10.01, 13.0)]
    acted = [(now, action) for now, action in checks if action is not None]
    assert 1.5 * PERIOD <= acted[0][0] - 10.0 <= 2.5 * PERIOD
    assert DEADLINE + BLIND_TIME < acted[-1][0] - 10.0 <= DEADLINE + BLIND_TIME + PERIOD
    np.testing.assert_allclose(np.diff([now for now, _ in acted]), PERIOD)
    # Each command acts from the state that TURNING and the commands before it have led to.
    motion, command, sent = flying_north(10.0), TURNING, iter(link.commands)
    for now, action in acted[:-1]:
        motion = propagate(motion, command, now, VEHICLE)
        assert action.motion is not None and action.command is not None
        np.testing.assert_allclose(action.motion.velocity, motion.velocity, atol=1e-9)
        command = action.command
        np.testing.assert_array_equal(command, next(sent))
    assert motion.speed < 0.3 and tilt(motion) < 0.5
    # From then on the drone does not obey the node any more.
    np.testing.assert_allclose(link.commands[-1], HOVER)
    assert acted[-1][1].command is None and len(link.commands) == len(acted)
    assert watchdog.interventions == 1 and watchdog.braking and not watchdog.needed


def test_until_the_deadline_it_sends_the_planned_commands(watchdog: Watchdog, link: RecordingLink):
    upcoming = np.array([[11.0 + k, 0.1 * k, 0.0, 0.0] for k in range(3)])
    watchdog.report(Heartbeat(10.0, flying_north(10.0), TURNING, upcoming))
    actions = [(now, watchdog.check(now)) for now in times(10.005, 10.2)]
    # Nothing while the tick may still come, then the planned commands while they last, then braking.
    assert [action is not None for _, action in actions[:2]] == [False, False]
    np.testing.assert_allclose(link.commands[:2], upcoming[1:])
    assert actions[3][1] is not None and actions[4][1] is None and actions[5][1] is not None
    assert actions[5][0] - 10.0 > DEADLINE and watchdog.interventions == 1
    # The drone has obeyed the command of the heartbeat and then the planned ones.
    motion = flying_north(10.0)
    for command, end in ((TURNING, 10.045), (upcoming[1], 10.065), (upcoming[2], 10.105)):
        motion = propagate(motion, command, end, VEHICLE)
    assert actions[5][1].motion is not None
    np.testing.assert_allclose(actions[5][1].motion.quaternion, motion.quaternion, atol=1e-9)


def test_a_late_loop_that_was_stopping_the_drone_is_replaced_before_the_deadline(
    watchdog: Watchdog, link: RecordingLink
):
    watchdog.report(Heartbeat(10.0, flying_north(10.0), TURNING))
    acted = [now for now in times(10.0, 10.0 + DEADLINE) if watchdog.check(now) is not None]
    # Not the rates of TURNING, which would last until the deadline: the nose goes up, against the velocity.
    np.testing.assert_allclose(acted, times(10.04, 10.0 + DEADLINE))
    assert all(command[1] < 0.0 and command[2] < -1.0 for command in link.commands)
    # This is no intervention: the loop may come back.
    assert watchdog.interventions == 0 and not watchdog.braking
    watchdog.report(Heartbeat(10.1, flying_north(10.1), TURNING))
    assert watchdog.check(10.11) is None


def test_a_dead_loop_is_replaced_even_before_a_tick_is_late(watchdog: Watchdog, link: RecordingLink):
    watchdog.report(Heartbeat(10.0, flying_north(10.0), HOVER, np.tile(HOVER, (3, 1))))
    assert watchdog.check(10.004) is None
    watchdog.declare_dead(10.005)
    assert watchdog.check(10.005) is not None
    assert link.commands[0][2] < -1.0  # nose up


def test_a_running_loop_is_left_alone(watchdog: Watchdog, link: RecordingLink):
    for now in times(10.0, 11.0):
        watchdog.report(Heartbeat(now, flying_north(now), HOVER))
        assert watchdog.check(now + 0.5 * PERIOD) is None
    assert watchdog.needed and not watchdog.braking and not link.commands


def test_a_loop_that_comes_back_is_left_alone_until_it_stalls_again(watchdog: Watchdog, link: RecordingLink):
    watchdog.report(Heartbeat(10.0, flying_north(10.0), HOVER))
    for now in times(10.0, 10.2):
        watchdog.check(now)
    count = len(link.commands)
    assert count > 0
    watchdog.report(Heartbeat(10.2, flying_north(10.2), HOVER))
    for now in times(10.2, 10.23):
        assert watchdog.check(now) is None
    assert len(link.commands) == count
    for now in times(10.23, 10.4):
        watchdog.check(now)
    assert len(link.commands) > count and watchdog.interventions == 2


@pytest.mark.parametrize("blind_time", [0.4, 0.6, 0.8])
def test_it_ends_level_however_short_its_time_is(link: RecordingLink, blind_time: float):
    stop = StopController(VEHICLE, BrakeSettings())
    watchdog = Watchdog(link, stop, VEHICLE, period=PERIOD, deadline=DEADLINE, blind_time=blind_time)
    tilted = MotionState(10.0, np.zeros(3), np.array([4.0, 0.0, 0.0]), quaternion_from_angles(10.0, 20.0, 30.0))
    watchdog.report(Heartbeat(10.0, tilted, TURNING))
    motions = [action.motion for now in times(10.01, 11.5) if (action := watchdog.check(now)) is not None]
    # The last command is to hover without turning, which only a level drone does.
    assert tilt(motions[0]) > 15.0 and tilt(motions[-2]) < 2.0
    np.testing.assert_allclose(link.commands[-1], HOVER)


@pytest.mark.parametrize(("motion", "command"), [(None, HOVER), (flying_north(10.0), None), (None, None)])
def test_it_is_silent_if_the_drone_does_not_obey(watchdog: Watchdog, link: RecordingLink, motion, command):
    watchdog.report(Heartbeat(10.0, motion, command))
    for now in times(10.0, 12.0):
        assert watchdog.check(now) is None
    assert not watchdog.needed and not link.commands


def test_it_is_silent_after_it_has_stalled_for_too_long_itself(watchdog: Watchdog, link: RecordingLink):
    watchdog.report(Heartbeat(10.0, flying_north(10.0), HOVER))
    assert watchdog.check(10.01) is None
    for now in times(12.0, 12.2):
        assert watchdog.check(now) is None
    assert not watchdog.needed and not link.commands


def test_a_dead_loop_is_replaced_at_once(watchdog: Watchdog, link: RecordingLink):
    watchdog.report(Heartbeat(10.0, flying_north(10.0), HOVER))
    assert watchdog.check(10.01) is None
    acted = []
    for now in times(10.012, 12.0):
        watchdog.declare_dead(now)
        if watchdog.check(now) is not None:
            acted.append(now)
    assert acted[0] == 10.012 and BLIND_TIME < acted[-1] - acted[0] <= BLIND_TIME + PERIOD
    np.testing.assert_allclose(link.commands[-1], HOVER)


def test_a_loop_declared_dead_later_is_replaced_for_the_same_time(watchdog: Watchdog):
    watchdog.report(Heartbeat(10.0, flying_north(10.0), HOVER))
    acted = []
    for now in times(10.0, 13.0):
        if now > 11.4:
            watchdog.declare_dead(now)
        if watchdog.check(now) is not None and watchdog.braking:
            acted.append(now)
    assert BLIND_TIME < acted[-1] - acted[0] + PERIOD <= BLIND_TIME + 2 * PERIOD
