"""Adherence to the limits of speed and descent in flight."""

import pytest

from aero_planner import PlannerConfig
from aero_viz.flight import FlightBatch, FlightRules
from aero_viz.scenes import World, scene


@pytest.mark.parametrize("limit", [0.5, 1.0, 3.0, 7.0])
def test_a_flight_keeps_to_the_speed_limit_and_makes_use_of_it(limit: float):
    """The weights of goal and speed limit balance where the drone is a little too fast."""
    config = PlannerConfig().replace({"vehicle.speed_limit": limit, "sampling.samples": 64})
    batch = FlightBatch([scene("forest", seed=0, count=60)], config=config, seed=3, rules=FlightRules(time_limit=4.0))
    (result,) = batch.run()
    batch.planner.close()
    assert 0.9 * limit < result.max_speed < 1.05 * limit + 0.25


@pytest.mark.parametrize("limit", [1.0, 3.0])
def test_a_drone_descends_no_faster_than_its_limit_and_makes_use_of_it(limit: float):
    bounds = [[-20, -20, 0], [30, 20, 40]]
    world = World.from_dict({"name": "descent", "start": [0, 0, 30], "goal": [6, 0, 10], "bounds": bounds})
    config = PlannerConfig().replace({"vehicle.descent_limit": limit, "sampling.samples": 64})
    batch = FlightBatch([world], config=config, seed=3)
    rates = []
    for _ in range(150):  # three seconds
        batch.step()
        rates.append(-batch.simulator.vehicle.velocity.numpy()[0, 2])
    batch.planner.close()
    assert 0.9 * limit < max(rates) < 1.05 * limit + 0.25
