"""A banked or sinking drone keeps its height while it is stopped, and climbs to the floor."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aero_planner import PlannerConfig
from aero_planner.onboard.braking_path import BrakingPath
from aero_planner.onboard.dead_reckoning import MotionState, propagate
from aero_planner.onboard.failsafe_table import State
from aero_planner.onboard.settings import BrakeSettings, ResponseSettings
from aero_planner.onboard.stop_controller import StopController
from aero_planner.quaternions import conjugate, rotate
from tests.planner.onboard.simulated import Simulation

VEHICLE = PlannerConfig().vehicle
RESPONSE = ResponseSettings()
PERIOD, HEIGHT = 0.02, 5.0
UP = np.array([0.0, 0.0, 1.0])
WEIGHT = VEHICLE.mass * VEHICLE.gravity
MAX_LOSS = 0.3
"""Loss of height that is allowed [m]."""

banks, headings = st.floats(0.0, 60.0), st.floats(0.0, 2.0 * math.pi)
speeds, sinks = st.floats(0.0, 7.0), st.floats(0.0, 2.0)
lifted = st.floats(0.0, 1.0)


def start(bank: float, heading: float, speed: float, sink: float, lift: float = 0.0) -> MotionState:
    """Return the motion of a drone that is banked [deg] about a horizontal axis at `heading` [rad] and flies north.

    `lift` is the share of the bank for which its thrust makes up.
    """
    half = 0.5 * math.radians(bank)
    quaternion = np.array([math.cos(half), math.sin(half) * math.cos(heading), math.sin(half) * math.sin(heading), 0.0])
    thrust = min(WEIGHT * (1.0 + lift * (1.0 / math.cos(2.0 * half) - 1.0)), VEHICLE.thrust_max)
    velocity = np.array([speed, 0.0, -sink])
    return MotionState(0.0, np.array([0.0, 0.0, HEIGHT]), velocity, quaternion, np.array([thrust, 0.0, 0.0, 0.0]))


def path_of(motion: MotionState) -> BrakingPath | None:
    """Return a path on which the drone stops along its velocity, descending if it sinks; None at rest."""
    speed = motion.speed
    if speed < 0.1:
        return None
    times = np.arange(0.0, speed / 5.0 + 0.05, 0.05)
    slowed = np.maximum(speed - 5.0 * times, 0.0)[:, None] * motion.velocity / speed
    steps = 0.5 * 0.05 * (slowed[1:] + slowed[:-1])
    return BrakingPath(0.05, motion.position + np.vstack([np.zeros((1, 3)), np.cumsum(steps, axis=0)]), slowed)


def stop(motion: MotionState, *, seconds: float = 2.5, **options) -> list[MotionState]:
    controller, motions = StopController(VEHICLE, BrakeSettings()), [motion]
    for _ in range(round(seconds / PERIOD)):
        command = controller.command(motions[-1], **options).control
        assert VEHICLE.thrust_min <= command[0] <= VEHICLE.thrust_max
        motions.append(propagate(motions[-1], command, motions[-1].time + PERIOD, VEHICLE, RESPONSE))
    return motions


def loss(motions: list[MotionState]) -> float:
    """Return how far the drone has sunk below its first height [m]."""
    return float(motions[0].position[2] - min(motion.position[2] for motion in motions))


def least_loss(motion: MotionState) -> float:
    """Return the loss of height of a drone that does all it can: it turns upright at once, with full thrust [m]."""
    motions = [motion]
    for _ in range(75):
        q = motions[-1].quaternion
        axis = np.cross(rotate(q, UP), UP)
        turn = rotate(conjugate(q), axis) / 0.1
        rates = turn * min(1.0, VEHICLE.rate_xy_max / max(float(np.abs(turn).max()), 1e-9))
        command = np.array([VEHICLE.thrust_max, rates[0], rates[1], 0.0])
        motions.append(propagate(motions[-1], command, motions[-1].time + PERIOD, VEHICLE, RESPONSE))
    return loss(motions)


@settings(max_examples=60, deadline=None)
@given(banks, headings, speeds, lifted, st.booleans())
def test_a_banked_drone_keeps_its_height(bank: float, heading: float, speed: float, lift: float, on_path: bool):
    motion = start(bank, heading, speed, 0.0, lift)
    motions = stop(motion, path=path_of(motion) if on_path else None)
    assert loss(motions) < MAX_LOSS
    assert max(motion.position[2] for motion in motions) < HEIGHT + 0.6


def test_no_thrust_stops_a_descent_at_2_m_s_within_the_loss_that_a_bank_may_cost():
    """The equation of a level drone with full thrust: dv/dt = F/m - g - k v, where F rises with the thrust's lag."""
    step, sink, force, sunk = 1e-4, 2.0, WEIGHT, 0.0
    while sink > 0.0:
        force += step * (VEHICLE.thrust_max - force) / RESPONSE.thrust_lag
        sink -= step * (force / VEHICLE.mass - VEHICLE.gravity + RESPONSE.drag * sink)
        sunk += step * sink
    assert sunk == pytest.approx(0.36, abs=0.01)
    motion = start(0.0, 0.0, 0.0, 2.0)
    assert least_loss(motion) == pytest.approx(sunk, abs=0.01)
    # The controller follows 0.05 m behind.
    assert loss(stop(motion)) < sunk + 0.06


@settings(max_examples=60, deadline=None)
@given(banks, headings, speeds, sinks, st.booleans())
def test_a_sinking_drone_loses_little_more_than_it_must(
    bank: float, heading: float, speed: float, sink: float, on_path: bool
):
    motion = start(bank, heading, speed, sink)
    lost = loss(stop(motion, path=path_of(motion) if on_path else None))
    assert lost < least_loss(motion) + 0.15
    if bank < 30.0 and sink < 1.0:
        assert lost < MAX_LOSS


@settings(max_examples=30, deadline=None)
@given(banks, headings, speeds, st.floats(0.0, 1.0))
def test_it_still_comes_to_rest(bank: float, heading: float, speed: float, sink: float):
    last = stop(start(bank, heading, speed, sink), seconds=5.0)[-1]
    assert last.speed < 0.1 and rotate(last.quaternion, UP)[2] > 0.999


@settings(max_examples=30, deadline=None)
@given(
    st.floats(0.05, 1.5),
    st.floats(0.0, 30.0),
    headings,
    st.floats(0.0, 4.0),
    st.sampled_from(("brake", "hold", "path")),
)
def test_below_the_floor_it_climbs_and_stays_above(depth: float, bank: float, heading: float, speed: float, how: str):
    motion, floor = start(bank, heading, speed, 0.0), HEIGHT + depth
    options = {"hold": motion.position} if how == "hold" else {"path": path_of(motion)} if how == "path" else {}
    motions = stop(motion, floor=floor, seconds=6.0, **options)
    heights = [float(motion.position[2]) for motion in motions]
    assert min(heights[250:]) > floor and max(heights) < floor + 0.8
    assert motions[-1].speed < 0.15


def test_above_the_floor_it_changes_nothing():
    controller, motion = StopController(VEHICLE, BrakeSettings()), start(20.0, 1.0, 3.0, 0.0)
    with_floor, without = (controller.command(motion, floor=floor).control for floor in (HEIGHT - 0.1, -math.inf))
    np.testing.assert_array_equal(with_floor, without)


@pytest.mark.parametrize("angle", [95.0, 135.0, 180.0])
def test_an_inverted_drone_turns_before_it_pushes(angle: float):
    half = 0.5 * math.radians(angle)
    inverted = np.array([math.cos(half), math.sin(half), 0.0, 0.0])
    motion = MotionState(0.0, np.zeros(3), np.array([2.0, 0.0, 0.0]), inverted)
    control = StopController(VEHICLE, BrakeSettings()).command(motion).control
    assert control[0] == VEHICLE.thrust_min and np.abs(control[1:3]).max() > 2.0


def test_the_node_climbs_when_it_has_sunk_below_the_floor(flight: Simulation):
    """The LiDAR dies, and the drone finds itself below the floor, as after a descent that nobody stopped."""
    floor = flight.node.ground.height + flight.node.config.limits.fence_height_min
    flight.lidar.alive = False
    assert flight.run_until(lambda: flight.node.state is State.BRAKING, 1.0)
    below = np.array([*flight.motion.position[:2], floor - 0.2])
    flight.motion = MotionState(flight.now, below, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    assert flight.run_until(lambda: flight.motion.position[2] > floor, 1.5)
    assert flight.node.state in (State.BRAKING, State.HOLDING)
