"""Sweeps of simulated pillars that move."""

import numpy as np
from numpy.typing import NDArray

from aero_planner import Arrival, Goal, Plan, Planner, Sweeps, VehicleState

Array = NDArray[np.float64]
PERIOD = 0.1
RADIUS = 0.3
GOAL = Goal((20.0, 0.0, 0.0))


def pillar_points(axis: Array, origin: Array, *, noise: float = 0.01, seed: int = 0) -> Array:
    """Return points [m], [n, 3], of the side of a pillar that faces `origin`, from 0.5 m below it to 1.3 m above."""
    rng = np.random.default_rng(seed)
    to_origin = origin[:2] - axis
    distance = np.linalg.norm(to_origin)
    half = np.arccos(RADIUS / distance)
    angle = np.arctan2(to_origin[1], to_origin[0]) + rng.uniform(-half, half, 1500)
    surface = axis + RADIUS * np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    direction = surface - origin[:2]
    surface += noise * rng.normal(size=(1500, 1)) * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return np.column_stack((surface, origin[2] + rng.uniform(-0.5, 1.3, 1500)))


def sweeps_of(
    pillars: list[tuple[Array, Array]],
    velocity: Array,
    *,
    count: int = 8,
    period: float = PERIOD,
    whole: int | None = None,
) -> tuple[Sweeps, Array]:
    """Return sweeps of pillars (axis at the end of the last sweep, velocity), and the last position of the drone.

    The drone flies at a constant `velocity`. Each sweep shows the pillars as they are in the middle of it.
    """
    sweeps, position = Sweeps(whole=whole), np.zeros(3)
    for k in range(count):
        age = (count - 1 - k) * period
        origin, position = -(age + 0.5 * period) * velocity, -age * velocity
        clouds = [
            pillar_points(axis - (age + 0.5 * period) * speed, origin, seed=100 * k + i)
            for i, (axis, speed) in enumerate(pillars)
        ]
        arrival = Arrival(1.0 + k * period, tuple(position.tolist()))
        sweeps = sweeps.add(np.concatenate(clouds).astype(np.float32), limit=30, arrival=arrival)
    return sweeps, position


def closing_in() -> Sweeps:
    """Return sweeps of pillars on all sides of the origin that close in on it."""
    axes = [4.0 * np.array([np.cos(angle), np.sin(angle)]) for angle in np.arange(20) * np.pi / 10]
    return sweeps_of([(axis, -0.4 * axis) for axis in axes], np.zeros(3))[0]


def plan_from(planner: Planner, sweeps: Sweeps, position: Array, *, later: float = 0.0) -> Plan:
    """Plan some time after the last sweep [s]."""
    arrival = sweeps.arrivals[-1]
    assert arrival is not None
    state = VehicleState(position, np.zeros(3), (1.0, 0.0, 0.0, 0.0), time=arrival.time + later)
    return planner.plan(state, GOAL, sweeps)


def dynamic_obstacles(plan: Plan) -> tuple[Array, Array, Array]:
    """Return positions [m], velocities [m/s] and radii [m] of the dynamic obstacles of a plan."""
    assert plan.moving is not None
    moving = (plan.moving.positions, plan.moving.velocities, plan.moving.radii)
    positions, velocities, radii = (array.astype(np.float64) for array in moving)
    return positions, velocities, radii
