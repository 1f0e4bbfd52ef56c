"""The guarantee: a drone that sees in all directions, flies its own model and plans at every tick hits nothing."""

from aero_planner import PlannerConfig
from aero_viz.flight import FlightBatch, FlightRules, VehicleModel
from aero_viz.scenes import scene
from aero_viz.sensors import lidar_model

FLIGHTS = {31187: 82, 5000: 0, 5001: 1}
"""Seed of the noise by that of the world. In the first, braking into unseen space led into a trunk after 6.4 s."""


def test_a_drone_that_sees_in_all_directions_hits_nothing(device: str):
    config = PlannerConfig()
    batch = FlightBatch(
        [scene("verticals", seed=seed, count=300) for seed in FLIGHTS],
        config=config,
        device=device,
        seed=list(FLIGHTS.values()),
        lidar=lidar_model("full-sphere"),
        vehicle=VehicleModel.from_config(config),
        rules=FlightRules(ticks_per_plan=1, time_limit=8.0),
    )
    results = batch.run()
    assert "collision" not in [result.reason for result in results]
    assert [result.arrived for result in results[1:]] == [True, True]
