"""What a goal asks of a flight: no overshoot, a steady hover, turns, lower speeds, safety where none can reach it."""

from typing import Any

import numpy as np
import pytest

from aero_planner import PlannerConfig
from aero_viz.flight import FlightBatch, FlightRules, StateNoise, VehicleModel, fly
from aero_viz.scenes import World, scene
from aero_viz.sensors import LidarModel
from tests.planner.reference import Array

LIDAR = LidarModel("sparse", points_per_sweep=4000)
GROUND = [10.0, 0.0, -0.5, 400.0, 400.0, 1.0, 0.0]
BOUNDS = np.array([[-60.0, -60.0, -5.0], [200.0, 60.0, 30.0]])
REAL = {"thrust_lag": 0.04, "rate_lag": 0.03, "drag": 0.25, "latency": 0.02}
NOISE = StateNoise(position=0.03, velocity=0.05, attitude=0.5)
FEW: dict[str, Any] = {"sampling.samples": 64, "sampling.effective_samples": 6.0}


def field(goal: tuple[float, float, float], *boxes: list[float], bounds: Array = BOUNDS) -> World:
    return World("field", np.array([0.0, 0.0, 2.0]), np.array(goal), boxes=np.array([*boxes, GROUND]), bounds=bounds)


def flights(worlds: list[World], limit: float, *, gusts: float = 1.5, preset: str = "default") -> FlightBatch:
    """Return flights of real drones that go on at the goal."""
    config = PlannerConfig.preset(preset).replace({**FEW, "vehicle.speed_limit": limit})
    return FlightBatch(
        worlds,
        config=config,
        lidar=LIDAR,
        vehicle=VehicleModel.from_config(config, **REAL, gust_speed=gusts),
        noise=NOISE,
        rules=FlightRules(ticks_per_plan=5, arrival_radius=1e-3, stall_time=1e6, time_limit=1e6),
    )


def flown(batch: FlightBatch, seconds: float) -> tuple[Array, Array, Array]:
    """Return positions [n, B, 3], velocities [n, B, 3] and statuses [n, B] after each tick; nobody collides."""
    rows = []
    for _ in range(round(seconds / 0.02)):
        batch.step()
        states = batch.simulator.vehicle.position, batch.simulator.vehicle.velocity, batch.planner.outputs.status
        rows.append([array.numpy().copy() for array in states])
    assert batch.simulator.active.numpy().all(), batch.results()
    positions, velocities, statuses = (np.array(column) for column in zip(*rows, strict=True))
    return positions, velocities, statuses


@pytest.mark.parametrize(("preset", "limit"), [("default", 3.0), ("default", 7.0), ("racer", 20.0)])
def test_a_drone_that_arrives_at_speed_does_not_overshoot(preset: str, limit: float):
    distance = 14.0 if limit < 10.0 else 50.0
    worlds = [field((distance, y, 2.5)) for y in (0.0, 3.0)]
    batch = flights(worlds, limit, preset=preset)
    positions, velocities, _ = flown(batch, 1.3 * distance / limit + 2.5)
    batch.close()
    assert np.linalg.norm(velocities, axis=2).max() > 0.8 * limit
    for i, world in enumerate(worlds):
        distances = np.linalg.norm(positions[:, i] - world.goal, axis=1)
        arrival = int(np.argmax(distances < 0.5))
        assert arrival > 0 and distances[arrival:].max() < 0.5


def test_a_drone_hovers_at_its_goal_in_strong_gusts():
    goals = [(3.0, 0.0, 2.0), (2.0, 2.0, 3.0)]
    batch = flights([field(goal) for goal in goals], 3.0, gusts=3.0)
    flown(batch, 4.0)
    distances = np.linalg.norm(flown(batch, 30.0)[0] - np.array(goals), axis=2)
    batch.close()
    assert np.mean(distances > 0.2) < 0.02 and distances.max() < 0.25


def test_a_goal_behind_a_fast_drone_is_turned_to_at_once():
    worlds = [field((60.0, 0.0, 2.0)), scene("forest", seed=0), scene("forest", seed=1)]
    batch = flights(worlds, 7.0)
    before, velocities, _ = flown(batch, 2.6)
    assert np.linalg.norm(velocities[-1], axis=1).min() > 5.0
    batch.simulator.set_goal(np.array([world.start for world in worlds]))
    positions, _, _ = flown(batch, 6.0)
    batch.close()
    assert (positions[:, :, 0].max(axis=0) - before[-1, :, 0]).max() < 6.0
    assert np.abs(positions[:, :, 1] - before[-1, :, 1]).max() < 8.0
    distances = np.linalg.norm(positions[-1] - np.array([world.start for world in worlds]), axis=1)
    assert distances.max() < 1.0


@pytest.mark.parametrize(("preset", "limit"), [("default", 7.0), ("racer", 25.0)])
def test_a_lower_speed_limit_is_obeyed_without_braking_candidates(preset: str, limit: float):
    """Nothing is near: whatever slows down is safe."""
    batch = flights([field((150.0, 0.0, 2.0)), field((150.0, 10.0, 4.0))], limit, preset=preset)
    _, velocities, _ = flown(batch, 2.6)
    assert np.linalg.norm(velocities[-1], axis=1).min() > 0.7 * limit
    batch.planner.configure(batch.planner.config.replace({"vehicle.speed_limit": 1.0}))
    _, velocities, statuses = flown(batch, 3.0)
    batch.close()
    assert not statuses.any() and np.linalg.norm(velocities[-1], axis=1).max() < 1.3


TOWER = [10.0, 0.0, 3.0, 3.0, 3.0, 6.0, 0.3]


@pytest.mark.parametrize(
    ("world", "place", "nearest"),
    [
        (field((10.0, 0.0, 2.0), TOWER), "inside an obstacle", 2.9),
        (field((10.0, 0.0, -2.0)), "2.00 m below the ground", 2.9),
        (field((10.0, 0.0, 7.0), bounds=np.array([[-9.0, -9.0, -1.0], [30.0, 9.0, 4.0]])), "outside the bounds", 4.2),
        (field((14.0, 12.0, 2.0), bounds=np.array([[-9.0, -9.0, -1.0], [10.0, 9.0, 9.0]])), "outside the bounds", 7.0),
    ],
)
def test_a_goal_that_no_drone_can_reach_is_neared_and_named(world: World, place: str, nearest: float):
    """The drone hovers as near to it as is safe, which ends the flight; it may have to look for a way first."""
    config = PlannerConfig().replace({**FEW, "vehicle.speed_limit": 3.0})
    result = fly(world, config=config, lidar=LIDAR, rules=FlightRules(ticks_per_plan=5), noise=NOISE)
    assert result.reason == "stall" and result.min_clearance is not None and result.min_clearance > 0.3
    explanation = str(result.explanation)
    assert f"lies {place}" in explanation and "as near to it as is safe" in explanation
    assert float(explanation.rpartition(" m from the goal")[0].rpartition(" ")[2]) < nearest
