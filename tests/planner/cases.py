"""Random situations for the planner, and the goal as the planner completes it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from aero_planner import Goal, Plan, Planner, PlannerConfig, VehicleState
from aero_planner.config import Value
from aero_planner.kernels.prediction import UNSTAMPED_PERIOD
from aero_planner.kernels.sweep_change import RECENT, RecentRows, SweepChange
from tests.planner.reference import Array, rotation, unit

PERIOD = float(UNSTAMPED_PERIOD)
SMALL: dict[str, Value] = {"sampling.samples": 16, "disturbance.disturbance_time": 0.0, "disturbance.drag_time": 0.0}
"""Few samples keep tests fast; only statistics depend on K. Cases do not follow each other as the states of a drone do,
so that the differences of their accelerations from those of the last plan are no disturbances."""

PLAN_ARRAYS = [
    "fine_range", "continued_cells", "safe_range", "safe_direction", "filtered_points", "initial_endpoints", "anchors",
    "guide_coefficients", "guides", "controls", "positions", "velocities", "quaternions", "stage1_cost", "stage2_cost",
    "goal_cost", "collision_cost", "clearance", "disturbance",
]  # fmt: skip


def config_of(preset: str = "default", **changes: Value) -> PlannerConfig:
    """Return a preset with few samples and `changes`, whose names carry "__" for the dot."""
    return PlannerConfig.preset(preset).replace(SMALL | {k.replace("__", "."): v for k, v in changes.items()})


def change_of_sweeps(recent: Sequence[int], device: str) -> wp.array:
    """Return a change in which no sweep arrives, and the motion is estimated from the rows `recent`, newest first."""
    change: Any = SweepChange()
    change.arrived, change.thinned = -1, -1
    change.recent = RecentRows(*recent, *[-1] * (int(RECENT) - len(recent)))
    return wp.array([change], dtype=SweepChange, device=device)


@dataclass
class Case:
    """One drone, its goal and its cloud, in float64 numbers that float32 represents exactly."""

    position: Array
    velocity: Array
    quaternion: Array
    acceleration: Array
    goal: Array
    points: np.ndarray

    @property
    def state(self) -> VehicleState:
        return VehicleState(self.position, self.velocity, self.quaternion, self.acceleration)

    def beside(self, x: float, y: float, z: float) -> Array:
        """Return the position x forward, y left, z up in the world, relative to the drone."""
        return exact(self.position + np.array([x, y, z]))

    def plan(self, planner: Planner, **options: object):
        return planner.plan(self.state, Goal(self.goal), self.points, **options)  # type: ignore[arg-type]

    def full_goal(self) -> tuple[Array, Array, Array]:
        """Return p_goal, v_goal, q_goal as `Goal` derives them: stop there, level, the nose toward the goal."""
        x, y, _ = self.goal - self.position
        forward = rotation(unit(self.quaternion))[:, 0]
        yaw = np.arctan2(y, x) if np.hypot(x, y) > 0.5 else np.arctan2(forward[1], forward[0])
        return self.goal, np.zeros(3), np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])


def batch_of(cases: Sequence[Case]) -> tuple[VehicleState, Goal, list[np.ndarray]]:
    """Return the states, the goals and the clouds of several cases as one batch."""
    position, velocity, quaternion, acceleration, goal = (
        np.stack([getattr(case, name) for case in cases])
        for name in ("position", "velocity", "quaternion", "acceleration", "goal")
    )
    return VehicleState(position, velocity, quaternion, acceleration), Goal(goal), [case.points for case in cases]


def kept_points(plan: Plan) -> Array:
    """Return the filtered cloud of a single drone's plan."""
    assert isinstance(plan.filtered_points, np.ndarray)
    return plan.filtered_points


def assert_same(a: Plan, b: Plan) -> None:
    """Assert that two plans are equal bit for bit."""
    for name in PLAN_ARRAYS:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    assert (a.kinds, a.best, a.status, a.dropped_points) == (b.kinds, b.best, b.status, b.dropped_points)
    assert a.drag == b.drag


def exact(values: object) -> Array:
    """Round to float32, so that both sides compute from the same numbers."""
    return np.asarray(values, dtype=np.float32).astype(np.float64)


def random_quaternion(rng: np.random.Generator, tilt: float = 0.7) -> Array:
    """Return an attitude of any heading, tilted by up to `tilt` [rad] about a random horizontal axis."""
    yaw, angle, axis = rng.uniform(-np.pi, np.pi), rng.uniform(0, tilt), rng.uniform(-np.pi, np.pi)
    heading = np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])
    s = np.sin(angle / 2)
    w, x, y, z = heading
    matrix = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return exact(matrix @ [np.cos(angle / 2), s * np.cos(axis), s * np.sin(axis), 0])


def random_cloud(rng: np.random.Generator, position: Array, count: int = 2000, nearest: float = 0.6) -> np.ndarray:
    """Return points from `nearest` to 13 m around the drone, some of them in clumps."""
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    clump = rng.normal(size=(12, 3)) * [4, 4, 2]
    points = direction * rng.uniform(nearest, 13, (count, 1))
    half = count // 2
    points[:half] = clump[rng.integers(12, size=half)] + rng.normal(size=(half, 3)) * 0.3
    points = points[np.linalg.norm(points, axis=1) >= nearest]
    return (points + position).astype(np.float32)


def random_case(seed: int, *, count: int = 2000, nearest: float = 0.6, speed: float = 4.0, tilt: float = 0.7) -> Case:
    rng = np.random.default_rng(seed)
    position = exact(rng.uniform(-20, 20, 3))
    return Case(
        position=position,
        velocity=exact(rng.normal(size=3) * speed / 2),
        quaternion=random_quaternion(rng, tilt),
        acceleration=exact(rng.normal(size=3)),
        goal=exact(position + rng.normal(size=3) * [15, 15, 3]),
        points=random_cloud(rng, position, count, nearest),
    )


def level_case(x: float = 20.0, *, speed: float = 0.0) -> Case:
    """Return a level drone at the origin with the goal `x` ahead [m], a velocity toward it [m/s], and no cloud."""
    case = random_case(0, count=0)
    case.position, case.velocity, case.acceleration = np.zeros(3), np.array([speed, 0.0, 0.0]), np.zeros(3)
    case.quaternion, case.goal = np.array([1.0, 0.0, 0.0, 0.0]), np.array([x, 0.0, 0.0])
    return case


def shell(position: Array, radius: float, count: int = 20000) -> np.ndarray:
    """Return points spread evenly on a sphere around the drone."""
    i = np.arange(count) + 0.5
    z, angle = 1 - 2 * i / count, np.pi * (1 + 5**0.5) * i
    ring = np.sqrt(1 - z * z)
    return (position + radius * np.stack((ring * np.cos(angle), ring * np.sin(angle), z), 1)).astype(np.float32)
