"""The equations of the paper in float64 NumPy, independent of the kernels."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_planner import PlannerConfig

Array = NDArray[Any]


# Attitude: unit quaternions w, x, y, z, body to world.


def quat_multiply(a: Array, b: Array) -> Array:
    """Return the Hamilton product."""
    w, x, y, z = a
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]) @ b


def rotation(q: Array) -> Array:
    """Return R(q), the matrix of a unit quaternion; also evaluated as it stands within RK4, where |q| strays from 1."""
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def unit(v: Array) -> Array:
    return v / np.linalg.norm(v)


# 2. and 3. Partition.


def cell_indices(directions: Array, rows: int, columns: int) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """Return row and column of each direction, and its distance to the nearest border in cells."""
    azimuth = np.arctan2(directions[..., 1], directions[..., 0])
    elevation = np.arcsin(np.clip(directions[..., 2] / np.linalg.norm(directions, axis=-1), -1.0, 1.0))
    row, column = (elevation / np.pi + 0.5) * rows, (azimuth / (2 * np.pi) + 0.5) * columns
    border = np.minimum(np.abs(row - np.round(row)), np.abs(column - np.round(column)))
    return np.clip(row.astype(int), 0, rows - 1), column.astype(int) % columns, border


def cell_centers(rows: int, columns: int) -> Array:
    """Return the unit directions of the centres of the cells, shape [rows, columns, 3]."""
    elevation = np.radians(-90 + (np.arange(rows) + 0.5) * 180 / rows)[:, None]
    azimuth = np.radians(-180 + (np.arange(columns) + 0.5) * 360 / columns)[None]
    return np.stack(
        (np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation) + 0 * azimuth), -1
    )


def partition(
    points: Array, position: Array, quaternion: Array, *, range_max: float, range_min: float, rows: int, columns: int
) -> tuple[Array, NDArray[np.intp]]:
    """Return r_ij and the index of the nearest point of each cell (-1 where empty), both of shape [rows, columns]."""
    fine, nearest = np.full((rows, columns), range_max), np.full((rows, columns), -1)
    with np.errstate(over="ignore", invalid="ignore"):
        offsets = points - position
        ranges = np.linalg.norm(offsets, axis=1)
        usable = np.flatnonzero(np.isfinite(points).all(axis=1) & (ranges <= range_max) & (ranges >= range_min))
    row, column, _ = cell_indices(offsets[usable] @ rotation(unit(quaternion)), rows, columns)
    for i, r, c in zip(usable, row, column, strict=True):
        if nearest[r, c] < 0 or ranges[i] < fine[r, c]:
            fine[r, c], nearest[r, c] = ranges[i], i
    return fine, nearest


def closed(fine: Array) -> Array:
    """Return the ranges [rows, columns] up to which fine cells are seen if holes of one cell in surfaces are closed."""
    beside = np.maximum(np.roll(fine, 1, axis=1), np.roll(fine, -1, axis=1))
    above, below = np.vstack((fine[1:], fine[-1:])), np.vstack((fine[:1], fine[:-1]))
    return np.minimum(fine, np.minimum(beside, np.maximum(above, below)))


def safe_cells(fine: Array, pool: int, row: int, column: int) -> tuple[float, Array]:
    """Return the maximum range of a coarse cell and the directions, shape [n, 3], of the fine cells that share it."""
    block = np.s_[row * pool : (row + 1) * pool, column * pool : (column + 1) * pool]
    ranges, directions = fine[block], cell_centers(*fine.shape)[block]
    return float(ranges.max()), directions[ranges == ranges.max()]


# 4. Anchors.


def lookahead(speed: float, goal_distance: float, config: PlannerConfig) -> float:
    """Return l, or lookahead_time v_limit if that is longer; with the options min(l, l_rest + 0.6 T v), and at most 0.6
    T v_limit and the distance to the goal.
    """
    steady, a = 0.6 * config.horizon, config.anchors
    longest = max(a.lookahead, a.lookahead_time * config.vehicle.speed_limit)
    at_speed = a.lookahead_rest + steady * speed if a.lookahead_rest < longest else np.inf
    return min(longest, at_speed, steady * config.vehicle.speed_limit, goal_distance)


def anchor_directions(position: Array, velocity: Array, goal: Array, config: PlannerConfig) -> Array:
    """Return the world directions of the initial endpoints of the first plan, shape [M_h M_v, 3]; columns run fastest.

    Later plans of a slow drone have other spreads, see `anchors.slow_cycle`.
    """
    a, (x, y, z) = config.anchors, goal - position
    spread, rise = (a.slow_spread, a.slow_rise) if np.linalg.norm(velocity) < a.slow_speed else (1.0, 1.0)
    spacing = np.radians(a.spacing) * (1.0 + (spread - 1.0) / a.slow_cycle)
    rise = np.radians(a.spacing) * (1.0 + (rise - 1.0) / a.slow_cycle)
    azimuth = np.arctan2(y, x) + (np.arange(a.columns) - (a.columns - 1) / 2) * spacing
    elevation = np.arctan2(z, np.hypot(x, y)) + (np.arange(a.rows) - (a.rows - 1) / 2) * rise
    return np.array([[np.cos(e) * np.cos(h), np.cos(e) * np.sin(h), np.sin(e)] for e in elevation for h in azimuth])


def clipped_length(length: float, free: float, config: PlannerConfig) -> float:
    """Return the length of a guide of a slow drone that is stuck, from l and the range of its fine cell."""
    return min(length, max(free - config.escape.guide_margin, config.escape.guide_min))


def escape_cost(p: Array, places: Array, nearest: float, goal: Array, config: PlannerConfig) -> float:
    """Return the cost of a rollout that ends at p [3] for places [n, 3] and the least distance to the goal so far."""
    c, distance = config.escape, float(np.linalg.norm(p - goal))
    depth = np.maximum(c.radius - np.linalg.norm(places - p, axis=1), 0.0).sum()
    ahead = np.clip(1.0 - (nearest - distance) / c.ahead, 0.0, 1.0)
    return float(c.q_escape * depth * min(1.0, distance / (0.5 * c.radius)) * ahead)


# 5. Guides.


def quintic(p0: Array, v0: Array, a0: Array, p1: Array, v1: Array, T: float) -> Array:
    """Return the coefficients a_0 .. a_5, shape [3, 6], by solving the six boundary conditions with a1 = 0."""
    conditions = [[1, 0, 0, 0, 0, 0], [0, 1, 0, 0, 0, 0], [0, 0, 2, 0, 0, 0], [T**k for k in range(6)]]
    conditions += [[k * T ** max(k - 1, 0) for k in range(6)], [k * (k - 1) * T ** max(k - 2, 0) for k in range(6)]]
    boundary = np.array([p0, v0, a0, p1, v1, np.zeros(3)])
    return np.asarray(np.linalg.solve(np.array(conditions, float), boundary).T, dtype=np.float64)


def sample_guide(coefficients: Array, times: Array) -> Array:
    """Return the positions at `times`, shape [n, 3]."""
    return (coefficients @ times[None, :] ** np.arange(6)[:, None]).T


# Model.


NO_DISTURBANCE = np.zeros(3)


def derivative(x: Array, u: Array, config: PlannerConfig, disturbance: Array, drag: float) -> Array:
    """Return dx/dt of x = [p, q, v] under u = (F_t, omega), a disturbance [m/s^2] and drag [1/s]."""
    q, v = x[3:7], x[7:]
    dv = rotation(q)[:, 2] * u[0] / config.vehicle.mass - [0, 0, config.vehicle.gravity] + disturbance - drag * v
    return np.concatenate((v, 0.5 * quat_multiply(q, np.concatenate(([0.0], u[1:]))), dv))


def rk4(x: Array, u: Array, config: PlannerConfig, disturbance: Array = NO_DISTURBANCE, drag: float = 0.0) -> Array:
    """Return the state after dt, with q renormalised."""
    h = config.sampling.dt
    k1 = derivative(x, u, config, disturbance, drag)
    k2 = derivative(x + h / 2 * k1, u, config, disturbance, drag)
    k3 = derivative(x + h / 2 * k2, u, config, disturbance, drag)
    k4 = derivative(x + h * k3, u, config, disturbance, drag)
    x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    x[3:7] = unit(x[3:7])
    return x


def hover(config: PlannerConfig) -> Array:
    return np.array([config.vehicle.mass * config.vehicle.gravity, 0.0, 0.0, 0.0])


def follow(control: Array, command: Array, time: float, config: PlannerConfig) -> tuple[Array, Array]:
    """Return the mean control over `time` and the one at its end, if it follows the command with the vehicle's lags."""
    v = config.vehicle
    lags = np.array([v.thrust_lag, v.rate_xy_lag, v.rate_xy_lag, v.rate_z_lag])
    with np.errstate(divide="ignore"):
        left = np.where(lags > 0.0, np.exp(-time / lags), 0.0)
    difference = control - command
    return command + lags / time * (1.0 - left) * difference, command + left * difference


@dataclass
class Rollout:
    """States after each control: p [N, 3], q [N, 4], v [N, 3]."""

    p: Array
    q: Array
    v: Array


def roll_out(
    position: Array,
    quaternion: Array,
    velocity: Array,
    controls: Array,
    config: PlannerConfig,
    control: Array | None = None,
    disturbance: Array = NO_DISTURBANCE,
    drag: float = 0.0,
) -> Rollout:
    """Return the states under commands; `control` is in effect at first, hover by default, and lags behind them."""
    x, states = np.concatenate((position, unit(quaternion), velocity)), []
    control = hover(config) if control is None else control
    for command in controls.astype(np.float64):
        mean, control = follow(control, command, config.sampling.dt, config)
        x = rk4(x, mean, config, disturbance, drag)
        states.append(x)
    x = np.array(states)
    return Rollout(x[:, :3], x[:, 3:7], x[:, 7:])


def follow_guide(
    coefficients: Array,
    quaternion: Array,
    yaw_rate: float,
    command: Array,
    control: Array,
    config: PlannerConfig,
    disturbance: Array = NO_DISTURBANCE,
    drag: float = 0.0,
) -> Array:
    """Return the nominal controls of an anchor, shape [N, 4], from the coefficients of its guide, shape [3, 6].

    `command` is in force at first, and `control` in effect.
    """
    dt, N, v, lag = config.sampling.dt, config.sampling.steps, config.vehicle, config.sampling.nominal_lag
    lead, q, controls = 2.0 * v.rate_xy_lag + lag, unit(quaternion), []
    limits = np.array([v.rate_xy_max, v.rate_xy_max, v.rate_z_max])

    def force(s: float) -> Array:
        velocity = coefficients[:, 1:] @ [k * s ** (k - 1) for k in range(1, 6)]
        acceleration = coefficients[:, 2:] @ [k * (k - 1) * s ** (k - 2) for k in range(2, 6)]
        return v.mass * (np.add(acceleration, [0.0, 0.0, v.gravity]) - disturbance + drag * velocity)

    for t in range(N):
        x, y, z = rotation(q).T @ unit(force(min((t + 1) * dt + lead, N * dt)))
        tilt = np.arctan2(np.hypot(x, y), z) / np.hypot(x, y) / (dt + lead)
        thrust = np.clip(force((t + 0.5) * dt) @ rotation(q)[:, 2], v.thrust_min, v.thrust_max)
        rates = np.clip([-tilt * y, tilt * x, yaw_rate], -limits, limits)
        if lag > 0.0:
            rates += np.exp(-dt / lag) * (command[1:] - rates)
        command = np.concatenate(([thrust], rates))
        mean, control = follow(control, command, dt, config)
        q = rk4(np.concatenate((np.zeros(3), q, np.zeros(3))), mean, config)[3:7]
        controls.append(command)
    return np.array(controls)


# Clearance and costs.


def clearance(positions: Array, points: Array, limit: float) -> Array:
    """Return the distance of each position, shape [n, 3], to the nearest point, at most `limit`."""
    if len(points) == 0:
        return np.full(len(positions), limit)
    distance = np.linalg.norm(positions[:, None] - points[None].astype(np.float64), axis=2).min(axis=1)
    return np.minimum(distance, limit)


def J_track(p: Array, guide: Array, config: PlannerConfig) -> float:
    return float(config.costs.q_track * np.linalg.norm(p - guide, axis=1).sum())


def J_vnorm(v: Array, config: PlannerConfig) -> float:
    return config.costs.q_vnorm * (v**2).sum()


def J_ctrl(u: Array, config: PlannerConfig) -> float:
    """Return Q_c |u_t|^2 over t = 0..N-2 and Q_cd |u_t - u_{t-1}|^2 over t = 1..N-2: the last control is free."""
    change = u[1:-1] - u[:-2]
    return config.costs.q_control * (u[:-1] ** 2).sum() + config.costs.q_control_rate * (change**2).sum()


def J_jump(u: Array, command: Array, config: PlannerConfig) -> float:
    """Return q_control_jump |omega_0 - omega|^2 of the first control u of a plan and the command in force."""
    return float(config.costs.q_control_jump * ((u[1:] - command[1:]) ** 2).sum())


def J_goal(x: Rollout, p_goal: Array, v_goal: Array, q_goal: Array, config: PlannerConfig) -> float:
    c, R_goal = config.costs, rotation(unit(q_goal))
    attitude = sum(np.linalg.norm(rotation(q) @ R_goal.T - np.eye(3)) for q in x.q)
    position, velocity = np.linalg.norm(x.p - p_goal, axis=1).sum(), np.linalg.norm(x.v - v_goal, axis=1).sum()
    height = np.abs(x.p[:, 2] - p_goal[2]).sum()
    return float(c.q_position * position + c.q_height * height + c.q_velocity * velocity + c.q_attitude * attitude)


def J_col(d: Array, config: PlannerConfig) -> float:
    c = config.costs
    if c.shape == "exponential":
        inside, between = np.full_like(d, c.penalty), c.penalty * np.exp(-c.decay * (d - c.distance_min))
    else:
        inside = c.penalty * (2.0 - d / max(c.distance_min, 1e-9))
        soft = c.soft_weight * min(1.0, config.vehicle.speed_limit / c.soft_speed)
        between = soft * ((c.distance_max - d) / (c.distance_max - c.distance_min)) ** 2
    return float(np.where(d < c.distance_min, inside, np.where(d < c.distance_max, between, 0.0)).sum())


def J_speed(v: Array, config: PlannerConfig) -> float:
    excess = np.maximum(np.linalg.norm(v, axis=1) - config.vehicle.speed_limit, 0.0)
    descent = np.maximum(-v[:, 2] - config.vehicle.descent_limit, 0.0)
    return float(config.costs.q_speed * (excess**2 + descent**2).sum())


def waypoint(p0: Array, anchor: Array, reach: float, goal: Array, config: PlannerConfig) -> Array:
    """Return the waypoint of an anchor; it is the goal if the path leads straight there."""
    distance = config.costs.waypoint_distance
    if not reach < distance < np.linalg.norm(goal - p0):
        return goal
    return p0 + distance * (anchor - p0) / np.linalg.norm(anchor - p0)


def probes(p: Array, waypoint: Array, goal: Array, config: PlannerConfig, count: int = 10) -> tuple[Array, float]:
    """Return the centres of `count` segments of the path from p by the waypoint to the goal, and its length."""
    corners = np.array([p, waypoint, goal])
    lengths = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))))
    length = min(config.costs.blocked_range, lengths[-1])
    places = (np.arange(count) + 0.5) / count * length
    return np.stack([np.interp(places, lengths, corners[:, axis]) for axis in range(3)], axis=1), length


def J_blocked(p: Array, waypoint: Array, goal: Array, points: Array, config: PlannerConfig) -> float:
    """Return the cost-to-go: q_blocked times the blocked length of the path from the final state to the goal."""
    if config.costs.q_blocked == 0.0:
        return 0.0
    radius = config.costs.blocked_radius
    places, length = probes(p, waypoint, goal, config)
    return config.costs.q_blocked * length * float((clearance(places, points, 2 * radius + 1) < radius).mean())


def S2(
    x: Rollout, waypoint: Array, p_goal: Array, v_goal: Array, q_goal: Array, points: Array, config: PlannerConfig
) -> float:
    """Return J_goal + J_col and the terms of the options."""
    d = clearance(x.p, points, config.costs.distance_max)
    options = J_speed(x.v, config) + J_blocked(x.p[-1], waypoint, p_goal, points, config)
    return J_goal(x, p_goal, v_goal, q_goal, config) + J_col(d, config) + options


def S1(
    x: Rollout,
    u: Array,
    guide: Array | None,
    waypoint: Array,
    goal: tuple[Array, Array, Array],
    points: Array,
    config: PlannerConfig,
) -> float:
    """Return J_track + J_vnorm + J_ctrl + S2, without J_track if there is no guide."""
    track = 0.0 if guide is None else J_track(x.p, guide, config)
    return track + J_vnorm(x.v, config) + J_ctrl(u, config) + S2(x, waypoint, *goal, points, config)


def softmin(S: Array, temperature: float) -> Array:
    """Return the weights exp(-(S - min S) / lambda) / sum along the last axis."""
    w = np.exp(-(S - S.min(axis=-1, keepdims=True)) / temperature)
    return w / w.sum(axis=-1, keepdims=True)
