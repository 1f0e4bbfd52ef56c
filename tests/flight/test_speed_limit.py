"""Adherence to the limit of speed in flight."""

import pytest

from aero_planner import PlannerConfig
from aero_viz.flight import FlightBatch, FlightRules
from aero_viz.scenes import scene


@pytest.mark.parametrize("limit", [0.5, 1.0, 3.0, 7.0])
def test_a_flight_keeps_to_the_speed_limit_and_makes_use_of_it(limit: float):
    """The weights of goal and speed limit balance where the drone is a little too fast."""
    config = PlannerConfig().replace({"vehicle.speed_limit": limit, "sampling.samples": 64})
    batch = FlightBatch([scene("forest", seed=0, count=60)], config=config, seed=3, rules=FlightRules(time_limit=4.0))
    (result,) = batch.run()
    batch.planner.close()
    assert 0.9 * limit < result.max_speed < 1.05 * limit + 0.25
