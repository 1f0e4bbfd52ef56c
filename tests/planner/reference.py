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


def safe_cells(fine: Array, pool: int, row: int, column: int) -> tuple[float, Array]:
    """Return the maximum range of a coarse cell and the directions, shape [n, 3], of the fine cells that share it."""
    block = np.s_[row * pool : (row + 1) * pool, column * pool : (column + 1) * pool]
    ranges, directions = fine[block], cell_centers(*fine.shape)[block]
    return float(ranges.max()), directions[ranges == ranges.max()]


# 4. Anchors.


def lookahead(goal_distance: float, config: PlannerConfig) -> float:
    """Return l, which grows with the speed limit and is at most 0.6 T v_limit and the distance to the goal."""
    longest = max(config.anchors.lookahead, config.anchors.lookahead_time * config.vehicle.speed_limit)
    return min(longest, 0.6 * config.horizon * config.vehicle.speed_limit, goal_distance)


def anchor_directions(position: Array, velocity: Array, goal: Array, config: PlannerConfig) -> Array:
    """Return the world directions of the initial endpoints, shape [M_h M_v, 3]; columns run fastest.

    With a way out, those of a drone below 3 m/s are spread.
    """
    a, (x, y, z) = config.anchors, goal - position
    is_spread = "way_out" in config.stages.names and np.linalg.norm(velocity) < 3.0
    across = config.way_out.spread if is_spread else 1.0
    up = 1.0 + 1.5 * (across - 1.0)
    spacing = np.radians(a.spacing)
    azimuth = np.arctan2(y, x) + (np.arange(a.columns) - (a.columns - 1) / 2) * spacing * across
    elevation = np.arctan2(z, np.hypot(x, y)) + (np.arange(a.rows) - (a.rows - 1) / 2) * spacing * up
    return np.array([[np.cos(e) * np.cos(h), np.cos(e) * np.sin(h), np.sin(e)] for e in elevation for h in azimuth])


def clipped_length(length: float, free: float) -> float:
    """Return the length of a guide that ends 0.2 m before the range of its fine cell, from l, at least 0.6 m."""
    return min(length, max(free - 0.2, 0.6))


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
    lags = np.array([v.thrust_lag, v.rate_lag, v.rate_lag, v.rate_lag])
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
    control: Array,
    config: PlannerConfig,
    disturbance: Array = NO_DISTURBANCE,
    drag: float = 0.0,
    command: Array | None = None,
) -> Array:
    """Return the nominal controls of an anchor, shape [N, 4], from the coefficients of its guide, shape [3, 6].

    `control` is in effect at first. From `command`, if given, they approach what the guide asks for with the lags.
    """
    before = command
    dt, N, v = config.sampling.dt, config.sampling.steps, config.vehicle
    lead, q, controls = 2.0 * v.rate_lag, unit(quaternion), []
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
        command = np.concatenate(([thrust], rates))
        if before is not None:
            _, command = follow(before, command, dt, config)
            before = command
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


# Terms of a rollout x under controls u at each time step, shape [N]. Their sums are those of the paper.


def J_track(p: Array, guide: Array, config: PlannerConfig) -> Array:
    return config.costs.q_track * np.linalg.norm(p - guide, axis=1)


def J_vnorm(v: Array, config: PlannerConfig) -> Array:
    return config.costs.q_vnorm * (v**2).sum(axis=1)


def J_effort(u: Array, config: PlannerConfig) -> Array:
    """Return Q_c |u_t|^2 over t = 0..N-2: the last control is free."""
    return config.costs.q_control * np.append((u[:-1] ** 2).sum(axis=1), 0.0)


def J_change(u: Array, config: PlannerConfig) -> Array:
    """Return Q_cd |u_t - u_{t-1}|^2 over t = 1..N-2."""
    change = np.diff(u[:-1], axis=0, prepend=u[:1])
    return config.costs.q_control_rate * np.append((change**2).sum(axis=1), 0.0)


def J_ctrl(u: Array, config: PlannerConfig) -> Array:
    return J_effort(u, config) + J_change(u, config)


def J_jump(u: Array, command: Array, config: PlannerConfig) -> Array:
    """Return q_control_jump |omega_0 - omega|^2 + q_thrust_jump (F_0 - F)^2, from the command in force to the first."""
    c, squares = config.costs, (u[0] - command) ** 2
    return np.append(c.q_control_jump * squares[1:].sum() + c.q_thrust_jump * squares[0], np.zeros(len(u) - 1))


def J_tilt(q: Array, config: PlannerConfig) -> Array:
    """Return 1000 max(0, cos(highest + 8 deg) - e_z)^2 with the stage unseen_space, with e_z as seen from the world."""
    highest = max(view.highest for view in config.unseen_space.views)
    excess = np.cos(np.radians(highest + 8.0)) - np.array([rotation(x)[2, 2] for x in q])
    return ("unseen_space" in config.stages.names) * 1000.0 * np.maximum(excess, 0.0) ** 2


def J_position(p: Array, p_goal: Array, config: PlannerConfig) -> Array:
    return config.costs.q_position * np.linalg.norm(p - p_goal, axis=1)


def J_velocity(v: Array, v_goal: Array, config: PlannerConfig) -> Array:
    return config.costs.q_velocity * np.linalg.norm(v - v_goal, axis=1)


def J_attitude(q: Array, q_goal: Array, config: PlannerConfig) -> Array:
    R_goal = rotation(unit(q_goal))
    return config.costs.q_attitude * np.array([np.linalg.norm(rotation(x) @ R_goal.T - np.eye(3)) for x in q])


def J_goal(x: Rollout, p_goal: Array, v_goal: Array, q_goal: Array, config: PlannerConfig) -> Array:
    return J_position(x.p, p_goal, config) + J_velocity(x.v, v_goal, config) + J_attitude(x.q, q_goal, config)


def J_col(d: Array, config: PlannerConfig) -> Array:
    c = config.costs
    if c.shape == "exponential":
        inside, between = np.full_like(d, c.penalty), c.penalty * np.exp(-c.decay * (d - c.distance_min))
    else:
        inside = c.penalty * (2.0 - d / max(c.distance_min, 1e-9))
        between = c.soft_weight * ((c.distance_max - d) / (c.distance_max - c.distance_min)) ** 2
    return np.where(d < c.distance_min, inside, np.where(d < c.distance_max, between, 0.0))


def J_speed(v: Array, config: PlannerConfig) -> Array:
    excess = np.maximum(np.linalg.norm(v, axis=1) - config.vehicle.speed_limit, 0.0)
    return config.costs.q_speed * excess**2


# Terms of the end p of a rollout.


def probes(p: Array, goal: Array, config: PlannerConfig, count: int = 10) -> tuple[Array, float]:
    """Return the centres of `count` segments of the straight path from p to the goal, and its length, at most l."""
    distance = float(np.linalg.norm(goal - p))
    length = min(config.anchors.lookahead, distance)
    places = (np.arange(count) + 0.5) / count * length
    return p + places[:, None] * (goal - p) / max(distance, 1e-6), length


def J_blocked(p: Array, goal: Array, points: Array, config: PlannerConfig) -> float:
    """Return the cost-to-go: q_blocked times the blocked length of the path from the final state to the goal."""
    places, length = probes(p, goal, config)
    d_min = config.costs.distance_min
    return config.costs.q_blocked * length * float((clearance(places, points, 2 * d_min + 1) < d_min).mean())


def J_escape(p: Array, places: Array, nearest: float, goal: Array, config: PlannerConfig) -> float:
    """Return q_escape times the depth of p in the neighbourhoods of places [n, 3].

    It fades out near the goal, and within 2 m nearer to it than `nearest`, where the drone has been.
    """
    radius, distance = config.way_out.radius, float(np.linalg.norm(p - goal))
    depth = np.maximum(radius - np.linalg.norm(places - p, axis=1), 0.0).sum()
    share = np.clip(1.0 + (distance - nearest) / 2.0, 0.0, 1.0)
    return float(config.way_out.q_escape * share * depth * min(1.0, distance / (0.5 * radius)))


def S2(
    x: Rollout, u: Array, goal: tuple[Array, Array, Array], points: Array, command: Array, config: PlannerConfig
) -> float:
    """Return J_goal + J_col and the terms of the options, without places to escape from."""
    d = clearance(x.p, points, config.costs.distance_max)
    steps = J_goal(x, *goal, config) + J_col(d, config) + J_speed(x.v, config)
    steps += J_jump(u, command, config) + J_tilt(x.q, config)
    return float(steps.sum()) + J_blocked(x.p[-1], goal[0], points, config)


def S1(
    x: Rollout,
    u: Array,
    guide: Array | None,
    goal: tuple[Array, Array, Array],
    points: Array,
    command: Array,
    config: PlannerConfig,
) -> float:
    """Return J_track + J_vnorm + J_ctrl + S2, without J_track if there is no guide."""
    track = 0.0 if guide is None else J_track(x.p, guide, config).sum()
    effort = J_vnorm(x.v, config).sum() + J_ctrl(u, config).sum()
    return float(track + effort) + S2(x, u, goal, points, command, config)


def softmin(S: Array, temperature: float | Array) -> Array:
    """Return the weights exp(-(S - min S) / lambda) / sum along the last axis."""
    w = np.exp(-(S - S.min(axis=-1, keepdims=True)) / temperature)
    return w / w.sum(axis=-1, keepdims=True)
