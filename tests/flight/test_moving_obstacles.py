"""Flights of a drone with lags, gusts and noise past a pillar that moves as fast as it does."""

import numpy as np
import pytest

from aero_planner import PlannerConfig
from aero_viz.flight import FlightResult, FlightRules, StateNoise, VehicleModel, fly
from aero_viz.scenes import World

GROUND = [[15.0, 0.0, -0.5, 200.0, 200.0, 1.0, 0.0]]
START, GOAL = np.array([0.0, 0.0, 2.0]), np.array([30.0, 0.0, 2.0])


def flight_past(pillar: tuple[float, float], velocity: tuple[float, float], *, speed: float, seed: int) -> FlightResult:
    """Fly to the goal past a pillar [m] that moves on for ever [m/s], at a speed limit [m/s]."""
    cylinder, motion = [[*pillar, 0.0, 0.0, 0.0, 1.0, 0.4, 6.0]], [[*velocity, 500.0]]
    world = World("pillar", START, GOAL, np.array(cylinder), np.array(GROUND), motion=np.array(motion))
    config = PlannerConfig.preset("default").replace({"vehicle.speed_limit": speed})
    return fly(
        world,
        config=config,
        seed=seed,
        vehicle=VehicleModel.from_config(config, drag=0.25, gust_speed=1.5, thrust_lag=0.04, rate_lag=0.03),
        noise=StateNoise(position=0.03, velocity=0.05, attitude=0.5),
        rules=FlightRules(ticks_per_plan=5, time_limit=30.0),
    )


@pytest.mark.parametrize(("speed", "seed"), [(2.0, 1), (3.0, 2)])
def test_a_pillar_that_crosses_as_fast_as_the_drone_may_go_first(speed: float, seed: int):
    """Both would be at x = 12 at the same time."""
    result = flight_past((12.0, -12.0), (0.0, speed), speed=speed, seed=seed)
    assert result.arrived, result.reason
    assert result.length_m < 45.0, "it has not flown beside the pillar"


@pytest.mark.parametrize("seed", [3, 4])
def test_a_fast_pillar_that_comes_head_on_is_evaded(seed: int):
    result = flight_past((35.0, 0.0), (-5.0, 0.0), speed=5.0, seed=seed)
    assert result.arrived, result.reason
