"""A LiDAR that loses every return is no proof that nothing is there; rays into the open are."""

import dataclasses

import numpy as np
import pytest

from aero_planner import Planner, PlannerConfig, PlanStatus
from aero_viz.flight import FlightBatch, FlightRules, FlightSource, fly
from aero_viz.scenes import World
from aero_viz.sensors import LidarModel

LIDAR = LidarModel("small", points_per_sweep=2000)
CONFIG = PlannerConfig.preset("fast-cpu").replace({"sampling.samples": 16})
WALL = World.from_dict({
    "name": "wall", "start": [0, 0, 2], "goal": [9, 0, 2],
    "boxes": [[0, 0, -0.5, 60, 60, 1, 0], [5, 0, 3, 1, 20, 6, 0]],
})  # fmt: skip
OPEN = World.from_dict({"name": "open", "start": [0, 0, 50], "goal": [3, 0, 50]})


@pytest.mark.parametrize("dropout", [1.0, 0.9999])
def test_a_lidar_without_returns_lets_the_drone_stop(dropout: float):
    blind = dataclasses.replace(LIDAR, dropout=dropout)
    result = fly(WALL, config=CONFIG, lidar=blind, rules=FlightRules(time_limit=3.0))
    assert result.reason == "timeout" and result.max_speed < 0.5

    batch = FlightBatch([WALL], config=CONFIG, lidar=blind)
    batch.step()
    assert batch.planner.outputs.status.numpy()[0] == PlanStatus.STALE_CLOUD


def test_a_lidar_that_fails_in_flight_makes_the_cloud_stale():
    source, planner = FlightSource(WALL, lidar=LIDAR), Planner(CONFIG)
    statuses = []
    for tick in range(40):
        if tick == 5:
            source.set_conditions({"lidar.dropout": 1.0})
        plan = source.observe().plan_with(planner)
        statuses.append(plan.status)
        source.advance(plan)
    assert PlanStatus.STALE_CLOUD not in statuses[:25] and statuses[-1] == PlanStatus.STALE_CLOUD


def test_a_drone_flies_where_nothing_is_in_range():
    result = fly(OPEN, config=CONFIG, lidar=LIDAR)
    assert result.reason == "arrived"
    source = FlightSource(OPEN, lidar=LIDAR)
    assert not np.isfinite(source.observe().points).any()
    batch = FlightBatch([OPEN], config=CONFIG, lidar=LIDAR)
    assert batch.run()[0].reason == "arrived"
