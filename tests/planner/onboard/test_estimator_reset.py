"""Estimator resets: what counts as one, and how the node reacts."""

import dataclasses

import numpy as np
import pytest

from aero_planner import Planner
from aero_planner.onboard.estimator_reset import EstimatorState, is_estimator_reset
from aero_planner.onboard.failsafe_table import State
from aero_planner.quaternions import integrate_rates, rotate
from tests.planner.onboard.conftest import Records
from tests.planner.onboard.simulated import CORRIDOR, Simulation, in_flight, poles

OFFSET = np.array([-1.5, 0.5, 0.0])
"""Change of the estimated position at the reset [m]."""


def flown(fix: EstimatorState, acceleration: np.ndarray, turning: np.ndarray, dt: float) -> EstimatorState:
    """Return the state after `dt` at constant acceleration [m/s^2] and angular acceleration [rad/s^2]."""
    time, p, v, q, rates = fix
    for _ in range(100):
        h = 0.01 * dt
        p, v = p + h * v + 0.5 * h * h * acceleration, v + h * acceleration
        q, rates = integrate_rates(q, rates + 0.5 * h * turning, h), rates + h * turning
    return EstimatorState(time + dt, p, v, q, rates)


@pytest.mark.parametrize("dt", [0.004, 0.02, 0.1, 0.3])
def test_no_flight_is_a_reset_and_every_reset_is_found(dt: float):
    random = np.random.default_rng(3)
    for _ in range(100):
        q = random.normal(size=4)
        before = EstimatorState(
            5.0, random.normal(size=3), random.normal(0, 5, 3), q / np.linalg.norm(q), random.normal(0, 3, 3)
        )
        # Accelerating and slowing down again deviates most from the mean velocity.
        hard, turning = random.normal(0, 10, 3), random.normal(0, 30, 3)
        after = flown(flown(before, hard, turning, 0.5 * dt), -hard, -turning, 0.5 * dt)
        assert not is_estimator_reset(before, after)
        assert not is_estimator_reset(before, after._replace(attitude=-after.attitude))  # the same attitude
        side = rotate(q / np.linalg.norm(q), np.array([1.3 + 10.0 * dt * dt, 0.0, 0.0]))
        assert is_estimator_reset(before, after._replace(position=after.position + side))
        turned = integrate_rates(after.attitude, np.array([0.0, 0.0, 1.0]), 0.35 + 100.0 * dt * dt)
        assert dt > 0.1 or is_estimator_reset(
            before, after._replace(attitude=turned)
        )  # later, any attitude is possible
        assert is_estimator_reset(before, after._replace(time=4.9))  # the autopilot has restarted


def shift(simulation: Simulation) -> None:
    """Reset the estimator."""
    simulation.link.spoil = lambda state: dataclasses.replace(state, position=state.position + OFFSET)
    simulation.link.resets += 1


def test_no_plan_uses_the_cloud_from_before_a_reset(small_planner: Planner):
    seen = Records()
    simulation = in_flight(small_planner, observers=[seen])
    world, count = poles(CORRIDOR), len(seen.plans)
    began = simulation.now
    shift(simulation)
    simulation.run(0.6)
    later = [record for record in seen.plans[count:] if record.time > began + 0.02]
    assert len(later) > 5
    for record in later:
        # Every point belongs to the world in the new estimate. Points from before would be off by OFFSET.
        for point in record.points[::50] - OFFSET:
            assert np.linalg.norm(world - point, axis=1).min() < 0.1
    # The first plan has a whole sweep, and the drone did not have to brake.
    assert later[0].time - began >= 0.1 and len(later[0].points) > 0.1 * len(later[-1].points)
    assert simulation.node.state is State.FLYING and not [c for c in simulation.node.changes if c.time > began]


def test_a_drone_that_holds_does_not_follow_a_reset(small_planner: Planner):
    simulation = in_flight(small_planner)
    simulation.lidar.alive = False
    assert simulation.run_until(lambda: simulation.node.state is State.HOLDING, 5.0)
    simulation.run(1.0)
    place = simulation.motion.position
    shift(simulation)
    simulation.run(2.0)
    assert simulation.node.state is State.HOLDING
    assert np.linalg.norm(simulation.motion.position - place) < 0.3


def test_a_reset_discards_the_history_of_the_planner(small_planner: Planner):
    simulation = in_flight(small_planner)
    simulation.planning_alive = False
    assert np.isfinite(small_planner.history().arrays["previous_time"]).all()
    shift(simulation)
    simulation.run(0.02)
    simulation.node.plan_once()
    assert np.isnan(small_planner.history().arrays["previous_time"]).all()
