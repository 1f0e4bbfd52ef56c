"""The costs S1 and S2 term by term and step by step, in float64 NumPy after the equations of the kernels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aero_planner import PlannerConfig
from aero_planner.kernels.mppi import PROBES
from aero_planner.plan import MovingObstacles
from aero_planner.quaternions import conjugate, multiply, rotate

Array = NDArray[np.float64]

STAGE2 = (
    "goal position", "goal height", "goal velocity", "goal attitude", "obstacles", "speed limit", "blocked path",
    "escape", "control jump",
)  # fmt: skip
"""Names of the terms of S2: the parts of J_goal, J_col, and the options."""
STAGE1 = ("guide tracking", "speed", "control effort", "control change", *STAGE2)
"""Names of the terms of S1: J_track, J_vnorm, the parts of J_ctrl, and S2."""


@dataclass(frozen=True, eq=False)
class Rollouts:
    """States after each of N controls, world frame; any leading axes."""

    positions: Array
    """[m], shape [.., N, 3]."""
    velocities: Array
    """[m/s], shape [.., N, 3]."""
    quaternions: Array
    """w x y z, body to world, shape [.., N, 4]."""


class Obstacles:
    """Distances as the planner measures them: to filtered cloud, moving obstacles, ground and the band of heights.

    Args:
        points: filtered cloud [m], shape [P, 3].
        ground_height: [m]; None where it is unknown.
        config: configuration of the planner.
        moving: obstacles that the planner tracks as moving.
    """

    def __init__(
        self,
        points: NDArray[np.float32],
        ground_height: float | None,
        config: PlannerConfig,
        moving: MovingObstacles | None = None,
    ) -> None:
        from scipy.spatial import KDTree  # takes 0.1 s to import, which the page need not wait for

        self.points = points
        self._moving = moving
        self._growth = config.partition.predict_growth
        self._tree = KDTree(points) if len(points) else None
        self._ground = -np.inf if ground_height is None or not config.costs.use_ground else ground_height
        self._band = config.costs.height_min, config.costs.height_max

    def distance(self, positions: Array, times: Array | None = None) -> Array:
        """Return the distance of each position [m], shape [.., 3], to the nearest obstacle [m].

        Args:
            positions: [m], shape [.., 3].
            times: time of each position in the plan [s], which broadcasts to [..]; None leaves out moving obstacles.
        """
        height = positions[..., 2]
        level = np.minimum(np.minimum(height - self._band[0], self._band[1] - height), height - self._ground)
        distance = np.minimum(self._nearest(positions)[0], np.maximum(level, 0.0))
        return distance if times is None else np.minimum(distance, self._nearest_moving(positions, times)[0])

    def speed_of_nearest(self, position: Array, time: float) -> float | None:
        """Return the speed of the nearest obstacle at a time in the plan [m/s]; None if it is static."""
        distance, row = self._nearest_moving(position, np.array(time))
        if self._moving is None or distance >= self.distance(position):
            return None
        return float(np.linalg.norm(self._moving.velocities[row]))

    def nearest_point(self, position: Array) -> NDArray[np.float32] | None:
        """Return the nearest point of the cloud [m], shape [3]; None where the ground or the band is nearer."""
        distance, row = self._nearest(position)
        return self.points[int(row)] if np.isfinite(distance) and distance <= self.distance(position) else None

    def _nearest_moving(self, positions: Array, times: Array) -> tuple[Array, NDArray[np.int64]]:
        """Return the distance [m] of each position to the nearest obstacle that moves, at its time [s], and the row."""
        if self._moving is None or not len(self._moving.radii):
            return np.full(positions.shape[:-1], np.inf), np.zeros(positions.shape[:-1], dtype=np.int64)
        times = np.broadcast_to(times, positions.shape[:-1])[..., None]
        axes = self._moving.positions + times[..., None] * self._moving.velocities
        gaps = np.linalg.norm(positions[..., None, :2] - axes, axis=-1) - self._moving.radii - times * self._growth
        return np.maximum(gaps.min(axis=-1), 0.0), gaps.argmin(axis=-1)

    def _nearest(self, positions: Array) -> tuple[Array, NDArray[np.int64]]:
        if self._tree is None:
            return np.full(positions.shape[:-1], np.inf), np.zeros(positions.shape[:-1], dtype=np.int64)
        distance, row = self._tree.query(positions)
        return np.asarray(distance), np.asarray(row, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class Problem:
    """Quantities that the costs of all rollouts share."""

    config: PlannerConfig
    goal: tuple[Array, Array, Array]
    """Position [m], velocity [m/s] and quaternion."""
    obstacles: Obstacles
    places: Array
    """Places without progress that were remembered [m], shape [n, 3]."""
    nearest: float
    """Distance to the goal when progress was last made [m]."""


def step_times(positions: Array, config: PlannerConfig) -> Array:
    """Return the time of each step of rollouts [.., N, 3] [s], shape [N]."""
    return config.sampling.dt * np.arange(1, positions.shape[-2] + 1)


def stage2_terms(
    x: Rollouts, controls: Array, command: Array, waypoint: Array, problem: Problem, *, collision: Array | None = None
) -> Array:
    """Return the terms `STAGE2` at each step, shape [terms, .., N]; their sum is S2.

    The blocked path and the escape term depend on the final state and count at the last step.

    Args:
        x: rollouts.
        controls: F_t [N] and omega [rad/s], shape [.., N, 4].
        command: control that is being flown, shape [4].
        waypoint: waypoint of the cost-to-go [m], shape [.., 3].
        problem: goal, obstacles and weights.
        collision: J_col at each step, shape [.., N]; None computes it.
    """
    c, vehicle = problem.config.costs, problem.config.vehicle
    p_goal, v_goal, q_goal = problem.goal
    if collision is None:
        times = step_times(x.positions, problem.config)
        collision = collision_cost(problem.obstacles.distance(x.positions, times), problem.config)
    error = multiply(x.quaternions, conjugate(q_goal))
    excess = np.maximum(np.linalg.norm(x.velocities, axis=-1) - vehicle.speed_limit, 0.0)
    descent = np.maximum(-x.velocities[..., 2] - vehicle.descent_limit, 0.0)
    end = x.positions[..., -1, :]
    at_end = np.zeros((2, *x.positions.shape[:-1]))
    at_end[0, ..., -1] = _blocked_cost(end, waypoint, problem)
    escape = problem.config.escape
    depth = np.maximum(escape.radius - np.linalg.norm(end[..., None, :] - problem.places, axis=-1), 0.0)
    distance = np.linalg.norm(end - p_goal, axis=-1)
    share = np.minimum(2.0 * distance / escape.radius, 1.0)
    share *= np.clip(1.0 + (distance - problem.nearest) / escape.ahead, 0.0, 1.0)
    at_end[1, ..., -1] = escape.q_escape * share * depth.sum(axis=-1)
    jump = np.zeros(x.positions.shape[:-1])
    jump[..., 0] = c.q_control_jump * ((controls[..., 0, 1:] - command[1:]) ** 2).sum(axis=-1)
    return np.stack(
        (
            c.q_position * np.linalg.norm(x.positions - p_goal, axis=-1),
            c.q_height * np.abs(x.positions[..., 2] - p_goal[2]),
            c.q_velocity * np.linalg.norm(x.velocities - v_goal, axis=-1),
            c.q_attitude * np.sqrt(8.0) * np.linalg.norm(error[..., 1:], axis=-1),
            collision,
            c.q_speed * (excess**2 + descent**2),
            *at_end,
            jump,
        )
    )


def stage1_terms(
    x: Rollouts,
    controls: Array,
    guide: Array | None,
    command: Array,
    waypoint: Array,
    problem: Problem,
    *,
    collision: Array | None = None,
) -> Array:
    """Return the terms `STAGE1` at each step, shape [terms, .., N]; their sum is S1.

    Args:
        x, controls, command, waypoint, problem, collision: as in `stage2_terms`.
        guide: guide at the times of the states [m], shape [N, 3]; None for the previous plan, which has no J_track.
    """
    c = problem.config.costs
    change = np.zeros(controls.shape[:-1])
    change[..., 1:-1] = c.q_control_rate * (np.diff(controls[..., :-1, :], axis=-2) ** 2).sum(axis=-1)
    effort = c.q_control * (controls**2).sum(axis=-1)
    effort[..., -1] = 0.0
    track = np.zeros(x.positions.shape[:-1])
    if guide is not None:
        track = c.q_track * np.linalg.norm(x.positions - guide, axis=-1)
    vnorm = c.q_vnorm * (x.velocities**2).sum(axis=-1)
    return np.concatenate(
        (
            np.stack((track, vnorm, effort, change)),
            stage2_terms(x, controls, command, waypoint, problem, collision=collision),
        )
    )


def collision_cost(distance: Array, config: PlannerConfig) -> Array:
    """Return J_col at each clearance [m]."""
    c = config.costs
    if c.shape == "exponential":
        cost = c.penalty * np.exp(-c.decay * np.maximum(distance - c.distance_min, 0.0))
    else:
        soft = c.soft_weight * min(1.0, config.vehicle.speed_limit / c.soft_speed)
        inside = c.penalty * (2.0 - distance / max(c.distance_min, 1e-9))
        share = (c.distance_max - distance) / (c.distance_max - c.distance_min)
        cost = np.where(distance < c.distance_min, inside, soft * share**2)
    return np.where(distance < c.distance_max, cost, 0.0)


def _blocked_cost(end: Array, waypoint: Array, problem: Problem) -> Array:
    """Return the cost-to-go of each final position [m], shape [.., 3]."""
    c, goal = problem.config.costs, problem.goal[0]
    if c.q_blocked == 0.0:
        return np.zeros(end.shape[:-1])
    first = np.linalg.norm(waypoint - end, axis=-1)[..., None]
    second = np.linalg.norm(goal - waypoint, axis=-1)[..., None]
    length = np.minimum(c.blocked_range, first + second)
    s = ((np.arange(int(PROBES)) + 0.5) / int(PROBES) * length)[..., None]
    first, second, waypoint, end = first[..., None], second[..., None], waypoint[..., None, :], end[..., None, :]
    before = end + s / np.maximum(first, 1e-6) * (waypoint - end)
    after = waypoint + (s - first) / np.maximum(second, 1e-6) * (goal - waypoint)
    blocked = problem.obstacles.distance(np.where(s <= first, before, after)) < c.blocked_radius
    return c.q_blocked * length[..., 0] * blocked.mean(axis=-1)


def roll_out(start: tuple[Array, Array, Array], control: Array, controls: Array, config: PlannerConfig) -> Rollouts:
    """Roll out controls by the model of the planner: RK4, with the lags of the vehicle.

    Args:
        start: position [m], velocity [m/s] and unit quaternion.
        control: control in effect at the start, shape [4].
        controls: F_t [N] and omega [rad/s], shape [.., N, 4].
        config: configuration of the planner.
    """
    vehicle, dt = config.vehicle, config.sampling.dt
    lags = np.array([vehicle.thrust_lag, vehicle.rate_xy_lag, vehicle.rate_xy_lag, vehicle.rate_z_lag])
    left = np.where(lags > 0.0, np.exp(-dt / np.maximum(lags, 1e-6)), 0.0)
    mean_left = lags * (1.0 - left) / dt
    shape = controls.shape[:-2]
    p, v, q = (np.broadcast_to(part, (*shape, len(part))) for part in start)
    states: list[tuple[Array, Array, Array]] = []
    for t in range(controls.shape[-2]):
        u = controls[..., t, :]
        mean, control = u + mean_left * (control - u), u + left * (control - u)

        def derivative(q: Array, u: Array = mean) -> tuple[Array, Array]:
            rate = np.concatenate((np.zeros((*shape, 1)), u[..., 1:]), axis=-1)
            thrust = u[..., :1] / vehicle.mass * rotate(q, np.array([0.0, 0.0, 1.0]))
            return thrust - [0.0, 0.0, vehicle.gravity], 0.5 * multiply(q, rate)

        a1, d1 = derivative(q)
        a2, d2 = derivative(q + 0.5 * dt * d1)
        a3, d3 = derivative(q + 0.5 * dt * d2)
        a4, d4 = derivative(q + dt * d3)
        p = p + dt * v + dt * dt / 6.0 * (a1 + a2 + a3)
        v = v + dt / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
        q = q + dt / 6.0 * (d1 + 2.0 * d2 + 2.0 * d3 + d4)
        q = q / np.linalg.norm(q, axis=-1, keepdims=True)
        states.append((p, v, q))
    positions, velocities, quaternions = (np.stack(part, axis=-2) for part in zip(*states, strict=True))
    return Rollouts(positions, velocities, quaternions)
