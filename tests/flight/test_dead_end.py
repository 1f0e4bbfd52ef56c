"""Flights into a dead end that encloses the straight line to the goal."""

import numpy as np

from aero_planner import PlannerConfig
from aero_viz.flight import FlightBatch, FlightRules
from aero_viz.scenes import World

BACK = [10.1, 0.0, 2.0, 0.2, 5.4, 4.0, 0.0]
SIDES = [[8.0, y, 2.0, 4.0, 0.2, 4.0, 0.0] for y in (-2.6, 2.6)]
GROUND = [3.0, 0.0, -0.5, 60.0, 60.0, 1.0, 0.0]


def dead_end() -> World:
    """Return a U of walls, 4 m deep and 5 m wide, open toward the start; the airspace ends at its top."""
    return World(
        "dead end",
        start=np.array([0.0, 0.0, 1.5]),
        goal=np.array([16.0, 0.0, 1.5]),
        boxes=np.array([BACK, *SIDES, GROUND]),
        bounds=np.array([[-25.0, -25.0, -0.5], [31.0, 25.0, 4.0]]),
    )


def test_only_remembered_places_lead_out_of_a_dead_end(device: str):
    config = PlannerConfig.preset("fast-cpu")
    configs = [config, config.replace({"way_out.q_escape": 0.0})]
    batch = FlightBatch(
        [dead_end()] * 2, config=configs, device=device, seed=[0, 0], rules=FlightRules(time_limit=12.0)
    )
    first, second = batch.run()
    x, y, z = batch.simulator.vehicle.position.numpy()[1]
    assert first.arrived
    assert not second.arrived and 6.0 < x < 10.0 and abs(y) < 2.5 and z < 4.0
