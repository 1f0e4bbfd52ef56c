"""A drone that sees with nothing but a depth camera."""

import numpy as np
import pytest

from aero_planner import PlannerConfig
from aero_planner.quaternions import rotate
from aero_viz.flight import FlightBatch, FlightRules, VehicleModel
from aero_viz.scenes import scene
from aero_viz.sensors import lidar_model


@pytest.mark.parametrize("lidar", ["d435", "d435+d435@180"])
def test_it_looks_where_it_flies(device: str, lidar: str):
    """At first to the goal; that moves then, beside the view."""
    config = PlannerConfig().replace({"vehicle.speed_limit": 3.0, "sampling.samples": 32})
    batch = FlightBatch(
        [scene("forest", seed=seed, count=40) for seed in (1, 2)],
        config=config,
        device=device,
        lidar=lidar_model(lidar),
        vehicle=VehicleModel.from_config(config),
        rules=FlightRules(ticks_per_plan=5, time_limit=9.0),
    )
    simulator, angles = batch.simulator, []
    start = simulator.vehicle.position.numpy().copy()
    for tick in range(300):
        if tick == 75:
            simulator.set_goal(simulator.vehicle.position.numpy() + np.array([0.0, 18.0, 0.0]))
        batch.step()
        v = simulator.vehicle.velocity.numpy()
        forward = rotate(simulator.vehicle.quaternion.numpy(), [1.0, 0.0, 0.0])
        off = np.arctan2(forward[:, 1], forward[:, 0]) - np.arctan2(v[:, 1], v[:, 0])
        fast = np.hypot(v[:, 0], v[:, 1]) > 1.5
        angles.extend(np.degrees(np.abs((off + np.pi) % (2 * np.pi) - np.pi))[fast])
    batch.close()
    assert "collision" not in [result.reason for result in batch.results()]
    assert (simulator.vehicle.position.numpy()[:, 1] - start[:, 1] > 6.0).all()
    assert len(angles) > 300 and np.mean(np.array(angles) < 43.5) > 0.95
