"""The guarantee: a drone that sees in all directions, flies its own model and plans at every tick hits nothing."""

import pytest

from aero_planner import PlannerConfig
from aero_viz.flight import FlightBatch, FlightRules, VehicleModel
from aero_viz.scenes import scene
from aero_viz.sensors import lidar_model

HARD = 31187
"""Seed of a world in which braking into unseen space leads into a trunk after 6.4 s, with the noise of seed 82."""


@pytest.fixture(scope="module")
def ends() -> dict[str, str | None]:
    """Why flights among verticals end within 7.5 s, by name."""
    config = PlannerConfig()
    unseen = config.replace({"candidates.brake_seen": False})
    flights = {
        "hard": (config, HARD, 82),
        "hard, braking into unseen space": (unseen, HARD, 82),
        "other": (config, 5000, 0),
    }
    configs, worlds, seeds = zip(*flights.values(), strict=True)
    batch = FlightBatch(
        [scene("verticals", seed=seed, count=300) for seed in worlds],
        config=configs,
        device="cpu",  # whose rounding leads to that trunk
        seed=seeds,
        lidar=lidar_model("full-sphere"),
        vehicle=VehicleModel.from_config(config),
        rules=FlightRules(ticks_per_plan=1, time_limit=7.5),
    )
    return dict(zip(flights, (result.reason for result in batch.run()), strict=True))


def test_a_drone_that_sees_in_all_directions_hits_nothing(ends):
    assert ends["hard"] != "collision" and ends["other"] == "arrived"


def test_a_drone_that_brakes_into_unseen_space_hits_a_trunk(ends):
    assert ends["hard, braking into unseen space"] == "collision"
