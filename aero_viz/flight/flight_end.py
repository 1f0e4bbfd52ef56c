"""Warp kernels that decide when a flight ends, and accumulate its metrics.

The simulator judges every tick as it is flown; a recorded trajectory is judged afterwards by the same functions.
"""

from __future__ import annotations

import warp as wp

from aero_viz.scenes.geometry import Geometry, world_distance

wp.set_module_options({"enable_backward": False})

# Indices into OUTCOMES of rules.py.
FLYING = wp.constant(0)
ARRIVED = wp.constant(1)
COLLISION = wp.constant(2)
STALL = wp.constant(3)
OUT_OF_BOUNDS = wp.constant(4)
TIMEOUT = wp.constant(5)


@wp.struct
class RuleParameters:
    """`FlightRules` for kernels."""

    period: float
    radius: float
    arrival_radius: float
    stall_distance: float
    stall_ticks: int
    """stall_time in ticks. Numbers of ticks are exact: in float32, 15 ticks of 0.02 s are less than 0.3 s."""
    limit_ticks: int
    """time_limit in ticks."""


@wp.struct
class FlightRecord:
    """Metrics of one flight so far."""

    goal: wp.vec3
    """[m], world frame."""
    is_last: int
    """1 if an arrival or a stall ends the flight; 0 on the way to a waypoint that others follow."""
    ticks: int
    """Number of ticks until the end of the flight."""
    length: float
    """Length of the path through the positions at the ticks [m]."""
    speed_max: float
    """Largest speed at a tick [m/s]."""
    smoothness: float
    """Integral of |da/dt|^2 dt [m^2/s^5], see `update_record`."""
    clearance_min: float
    """Smallest distance from the centre to a surface at any integration step [m]."""
    clearance_sum: float
    """Sum of these distances [m]."""
    clearance_count: int
    """Number of these distances."""
    acceleration: wp.vec3
    """Mean acceleration over the last tick [m/s^2]."""
    velocity: wp.vec3
    """Velocity at the last tick [m/s]."""
    progress_position: wp.vec3
    """Position at which progress was last made [m], world frame."""
    progress_tick: int
    """Number of ticks until progress was last made."""
    goal_tick: int
    """Number of ticks until the goal was set."""


@wp.func
def update_record(
    rules: RuleParameters,
    tick: int,
    position: wp.vec3,
    position_before: wp.vec3,
    velocity: wp.vec3,
    clearance: wp.array2d(dtype=float),
    row: int,
    record: FlightRecord,
):
    """Return the record after a tick; `clearance`[row] are the distances at its integration steps [m].

    Smoothness is the sum of |a_k - a_(k-1)|^2 / dt over the ticks with a_k = (v_(k+1) - v_k) / dt, the mean
    acceleration of a tick, and a_(-1) = 0, since the drone hovers before it starts.
    """
    r = record
    nearest = float(wp.inf)
    for s in range(clearance.shape[1]):
        nearest = wp.min(nearest, clearance[row, s])
        r.clearance_sum += clearance[row, s]
    r.clearance_count += clearance.shape[1]
    r.clearance_min = wp.min(r.clearance_min, nearest)
    if tick > 0:
        acceleration = (velocity - r.velocity) / rules.period
        r.smoothness += wp.length_sq(acceleration - r.acceleration) / rules.period
        r.acceleration = acceleration
    r.velocity = velocity
    r.length += wp.length(position - position_before)
    r.speed_max = wp.max(r.speed_max, wp.length(velocity))
    r.ticks = tick
    # Progress is motion, not motion toward the goal: the way out of a dead end leads away from it.
    if wp.length(position - r.progress_position) >= rules.stall_distance:
        r.progress_position = position
        r.progress_tick = tick
    return r


@wp.func
def flight_outcome(rules: RuleParameters, lower: wp.vec3, upper: wp.vec3, position: wp.vec3, record: FlightRecord):
    """Return the outcome after the last tick of the record; lower, upper: bounds of the world [m]."""
    inside = True
    for i in range(3):
        inside = inside and position[i] >= lower[i] and position[i] <= upper[i]
    outcome = FLYING
    if record.clearance_min < rules.radius:  # no earlier tick was that close, or the flight would have ended there
        outcome = COLLISION
    elif record.is_last != 0 and wp.length(record.goal - position) <= rules.arrival_radius:
        outcome = ARRIVED
    elif not inside:
        outcome = OUT_OF_BOUNDS
    elif record.is_last != 0 and record.ticks - record.progress_tick >= rules.stall_ticks:
        outcome = STALL
    elif record.ticks - record.goal_tick >= rules.limit_ticks:
        outcome = TIMEOUT
    return outcome


@wp.kernel
def judge_kernel(
    # problem
    rules: RuleParameters,
    tick: int,  # 0 at the start
    lower: wp.array(dtype=wp.vec3),  # [B]
    upper: wp.array(dtype=wp.vec3),  # [B]
    # in
    positions: wp.array(dtype=wp.vec3),  # [B]
    positions_before: wp.array(dtype=wp.vec3),  # [B]
    velocities: wp.array(dtype=wp.vec3),  # [B]
    clearance: wp.array2d(dtype=float),  # [B, S]
    # in/out
    records: wp.array(dtype=FlightRecord),  # [B]
    outcomes: wp.array(dtype=int),  # [B]
    active: wp.array(dtype=int),  # [B], 1 while flying, else 0
):
    """Update the records of the flights that are flying after a tick, and end those that have to end."""
    b = wp.tid()
    if outcomes[b] != FLYING:
        return
    record = update_record(rules, tick, positions[b], positions_before[b], velocities[b], clearance, b, records[b])
    outcomes[b] = flight_outcome(rules, lower[b], upper[b], positions[b], record)
    active[b] = wp.where(outcomes[b] == FLYING, 1, 0)
    records[b] = record


@wp.kernel
def judge_trajectory_kernel(
    # problem
    rules: RuleParameters,
    lower: wp.vec3,
    upper: wp.vec3,
    # in
    positions: wp.array(dtype=wp.vec3),  # [n], at the ticks
    velocities: wp.array(dtype=wp.vec3),  # [n]
    clearance: wp.array2d(dtype=float),  # [n, S]
    # in/out
    records: wp.array(dtype=FlightRecord),  # [1]
    outcomes: wp.array(dtype=int),  # [1]
):
    """Judge a recorded trajectory tick by tick until it ends, by one thread."""
    record = records[0]
    outcome = int(FLYING)
    for tick in range(positions.shape[0]):
        if outcome == FLYING:
            position = positions[tick]
            position_before = positions[wp.max(tick - 1, 0)]
            record = update_record(rules, tick, position, position_before, velocities[tick], clearance, tick, record)
            outcome = flight_outcome(rules, lower, upper, position, record)
    records[0] = record
    outcomes[0] = outcome


@wp.kernel
def clearance_kernel(
    # problem
    geometry: Geometry,
    world: wp.array(dtype=int),  # [B]
    threads: int,  # that share one query
    time: float,  # of the last integration step [s]
    step: float,  # between integration steps [s]
    # in
    active: wp.array(dtype=int),  # [B]
    positions: wp.array2d(dtype=wp.vec3),  # [B, S]
    # in/out
    clearance: wp.array2d(dtype=float),  # [B, S]
):
    """Lower the clearance [m] at each integration step to the distance from the nearest surface."""
    b, s, thread = wp.tid()
    if active[b] != 0:
        then = wp.max(time - float(positions.shape[1] - 1 - s) * step, 0.0)
        wp.atomic_min(clearance, b, s, world_distance(geometry, world[b], positions[b, s], then, thread, threads))
