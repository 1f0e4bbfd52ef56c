"""A small flight for tests of the engine: a real planner, LiDAR and vehicle in a world of three poles."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from aero_planner import PlannerConfig
from aero_viz.flight import FlightRules, FlightSource
from aero_viz.scenes import World
from aero_viz.sensors import LidarModel


def small_config() -> PlannerConfig:
    """Return the default configuration with few samples, which plans in a few milliseconds."""
    return PlannerConfig().replace({"sampling.samples": 16})


def small_source(*, goal: float = 12.0, kind: type[FlightSource] = FlightSource) -> FlightSource:
    """Return a flight of a few seconds between three poles."""
    poles = [[4.0, y, 0.0, 0.0, 0.0, 1.0, 0.3, 4.0] for y in (-2.0, 0.3, 2.5)]
    world = World(
        name="poles", start=np.array([0.0, 0.0, 2.0]), goal=np.array([goal, 0.0, 2.0]), cylinders=np.array(poles),
        boxes=np.array([[5.0, 0.0, -0.5, 60.0, 60.0, 1.0, 0.0]]), spheres=np.zeros((0, 4)),
    )  # fmt: skip
    lidar = LidarModel("sparse", points_per_sweep=2000)
    return kind(world, lidar=lidar, rules=FlightRules(time_limit=20.0), seed=1)


def wait_for(condition: Callable[[], Any], timeout: float = 60.0) -> None:
    """Wait until `condition` holds."""
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, f"the condition did not hold within {timeout} s"
        time.sleep(0.005)
