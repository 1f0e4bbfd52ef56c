"""Backup stops of the candidates: their own controls up to a switch time, then braking as long as the horizon.

A candidate may be flown if at least one of its stops is clear and in seen space. The controls of that stop are kept. If
no candidate of the next plan may be flown, the drone flies the kept stop, which is still clear unless new points have
appeared.
"""

# Postponed annotations are left out: kernels made for a composition refer to local types.

import functools
from typing import Any

import warp as wp

from aero_planner.composition import Composition
from aero_planner.device.hook_records import Fallback
from aero_planner.device.kernel_tuning import KernelTuning
from aero_planner.device.params import Params
from aero_planner.device.quintics import quintic
from aero_planner.device.records import (
    Cells,
    Problem,
    Rollouts,
    Scores,
    Start,
    grid_struct,
)
from aero_planner.device.rotations import quat_inverse_rotate
from aero_planner.kernels.clearance import above_ground, cell_size, clearance_at
from aero_planner.kernels.guides import FAN_ANGLE, braking_end
from aero_planner.kernels.partition import cell_of_direction
from aero_planner.plan import PlanStatus

wp.set_module_options({"enable_backward": False})

ALWAYS_SEEN = wp.constant(0.5)
"""Distance from the drone up to which nothing is occluded [m]."""
STOPS = wp.constant(6)
"""Stops of a candidate: three that leave it at once, straight ahead and to either side, and three that leave it after a
quarter, half and all of the horizon."""
STOPPED = wp.constant(1.0)
"""Speed below which a braking manoeuvre counts as a stop at its end [m/s]."""
_WIDEST = wp.constant(0.5)
"""Share of the clearance that is demanded of a stop above which one that is not clear is still worth more than braking
that is not clear either: with less, contact is certain, and braking makes it slow."""
_NO_SAFE_CANDIDATE = wp.constant(int(PlanStatus.NO_SAFE_CANDIDATE))


@wp.struct
class Stops:
    """Backup stops of all candidates; stop j of instance m is in row m STOPS + j of J = M STOPS."""

    stop_controls: wp.array3d(dtype=wp.vec4)  # [B, J, N], of the braking manoeuvre
    stop_positions: wp.array3d(dtype=wp.vec3)  # [B, J, N + 1], its rollout, world frame [m]
    stop_clearance: wp.array2d(dtype=float)  # [B, J], least clearance, at most safe_clearance [m]


@wp.struct
class StopProof:
    """What the selection reads."""

    stop_clearance: wp.array2d(dtype=float)  # as in `Stops`
    stop_ready: wp.array(dtype=int)  # as in `proven_stop.ProvenStop`
    least_clearance: wp.array2d(dtype=wp.vec2)  # as in `Scores`
    static_clearance: wp.array3d(dtype=float)  # as in `Scores`


@wp.func
def switch_step(stop: int, steps: int, period: float, dt: float) -> int:
    """Return the time step at which a stop leaves its candidate; the first ones after the time until the next plan."""
    first = wp.clamp(int(wp.ceil(period / dt - 1.0e-3)), 1, steps)
    step = first
    if stop == 3:
        step = steps // 4
    if stop == 4:
        step = steps // 2
    if stop == 5:
        step = steps
    return wp.max(step, first)


@wp.func
def stop_angle(stop: int) -> float:
    """Return the angle of the braking manoeuvre to the left of the velocity [rad]."""
    side = float(0.0)
    if stop == 1:
        side = 1.0
    if stop == 2:
        side = -1.0
    return side * FAN_ANGLE


@wp.func
def clear_stop(start_clearance: float, c: Any) -> float:
    """Return the clearance that is demanded of a stop [m].

    For a drone that is nearer than that at the start, it is clear not to come nearer still.
    """
    least = wp.min(c.stop_clearance, c.safe_clearance)
    return wp.where(start_clearance < least, start_clearance - 0.005, least)


@wp.func
def is_occluded(b: int, x: wp.vec3, problem: Problem, cells: Cells) -> bool:
    """Return True if x is farther away than `ALWAYS_SEEN`, and behind the nearest point of its fine cell."""
    to_x = quat_inverse_rotate(wp.normalize(problem.quaternion[b]), x - problem.position[b])
    distance = wp.length(to_x)
    occluded = bool(False)
    if distance > ALWAYS_SEEN:
        row, column = cell_of_direction(to_x, cells.rows, cells.columns)
        occluded = distance > cells.range[b, row * cells.columns + column]
    return occluded


@functools.cache
def roll_out_stops(tuning: KernelTuning, composition: Composition) -> wp.Kernel:
    """Return the kernel that rolls out the braking manoeuvre of every stop."""
    model = composition.model
    constants, step, respond, acceleration_of, follow = (
        model.constants, model.step, model.respond, model.acceleration, model.follow,
    )  # fmt: skip

    @wp.kernel(module="unique", enable_backward=False)
    def roll_out_stops(
        # share of the stops
        first: int,
        # problem
        problem: Problem,
        start: Start,
        # configuration
        params: wp.array(dtype=Params),
        # in
        rollouts: Rollouts,
        # out
        stops: Stops,
    ):
        """Roll out the braking manoeuvre of every stop. Launched over [B, stops of this share]."""
        b, offset = wp.tid()
        c = params[b]
        if problem.active[b] == 0 or c.prove_stop == 0:
            return
        i = first + offset
        m = i // STOPS
        stop = i % STOPS
        steps = stops.stop_controls.shape[2]
        T = float(steps) * c.dt
        s = switch_step(stop, steps, start.period[b], c.dt)
        p = rollouts.positions[b, m, s]
        v = rollouts.velocities[b, m, s]
        q = rollouts.quaternions[b, m, s]
        k = constants(start.disturbance[b], start.drag[b], c.dt, c)
        acting = start.control[b]
        for t in range(s):
            acting = respond(rollouts.controls[b, m, t], acting, c.dt, c)
        end = braking_end(p, v, stop_angle(stop), T, c)
        guide = quintic(p, v, acceleration_of(v, q, acting, k), end, wp.vec3(0.0, 0.0, 0.0), T)
        stops.stop_positions[b, i, 0] = p
        for t in range(steps):
            u = follow(p, v, q, acting, guide, float(t) * c.dt, 0.0, k, c)
            p, v, q, acting = step(p, v, q, acting, u, k)
            stops.stop_controls[b, i, t] = u
            stops.stop_positions[b, i, t + 1] = p
        # A manoeuvre that has not stopped proves nothing.
        stops.stop_clearance[b, i] = wp.where(wp.length(v) < STOPPED, c.safe_clearance, 0.0)

    return tuning.set_options(roll_out_stops)


@functools.cache
def evaluate_stops(tuning: KernelTuning, composition: Composition) -> wp.Kernel:
    """Return the kernel that finds the clearance of all stops.

    A thread looks at `tuning.rows_per_stop_query` positions; `tuning.threads_per_stop_query` threads share a position.
    """
    clearance_of = clearance_at(tuning.points_per_pack, tuning.threads_per_stop_query)
    ROWS = wp.constant(tuning.rows_per_stop_query)
    Grid: Any = grid_struct(tuning.points_per_pack)
    Views, dynamic = composition.Views, composition.hooks.clearance

    @wp.kernel(module="unique", enable_backward=False)
    def evaluate_stops(
        # share of the stops
        first: int,
        # problem
        problem: Problem,
        start: Start,
        # configuration
        params: wp.array(dtype=Params),
        # in
        cells: Cells,
        grid: Grid,
        views: Views,
        positions: wp.array3d(dtype=wp.vec3),
        scores: Scores,
        # in and out
        stops: Stops,
    ):
        """Lower the clearance of every stop to the least of its states, those of the candidate before the switch
        included. Below the share `_WIDEST` of what is demanded, it may stay larger than the least.

        Of 2 N positions, the first half are those of the braking manoeuvre, the others those of the candidate. Dynamic
        obstacles that are near at the start count as farther away. Launched over [B, stops of this share, 2 N / ROWS,
        threads per query].
        """
        b, offset, group, thread = wp.tid()
        c = params[b]
        if problem.active[b] == 0 or c.prove_stop == 0:
            return
        i = first + offset
        m = i // STOPS
        steps = stops.stop_controls.shape[2]
        last = scores.state_clearance.shape[2] - 1
        demanded = clear_stop(scores.static_clearance[b, m, last], c)
        allowance = demanded - clear_stop(scores.state_clearance[b, m, last], c)
        switch = switch_step(i % STOPS, steps, start.period[b], c.dt)
        size = cell_size(problem.velocity[b], c)
        floor = _WIDEST * demanded
        least = float(c.safe_clearance)
        for row in range(group * ROWS, wp.min(group * ROWS + ROWS, 2 * steps)):
            # Both branches are skipped once the stop is known to be of no use.
            t = row % steps
            if row < steps and least >= floor:
                x = stops.stop_positions[b, i, t + 1]
                margin = c.speed_margin * wp.length(x - stops.stop_positions[b, i, t]) / c.dt
                limit = wp.min(c.safe_clearance + margin, size)
                d = clearance_of(x, limit, b, thread, problem.position[b], size, grid)
                d = above_ground(d, x, problem.ground_height[b], c)
                time = float(switch + t + 1) * c.dt
                d = wp.min(d, dynamic(wp.INF, x, time, b, views, c) + allowance) - margin
                least = wp.min(least, wp.where(is_occluded(b, x, problem, cells), 0.0, d))
            elif row >= steps and t < switch and least >= floor:
                d = wp.min(scores.static_clearance[b, m, t], scores.state_clearance[b, m, t] + allowance)
                least = wp.min(least, wp.where(is_occluded(b, positions[b, m, t + 1], problem, cells), 0.0, d))
        if thread == 0 and least < c.safe_clearance:
            wp.atomic_min(stops.stop_clearance, b, i, least)

    return tuning.set_options(evaluate_stops, keep_loops=True)


@wp.func
def stop_to_keep(b: int, m: int, demanded: float, stop_clearance: wp.array2d(dtype=float)) -> int:
    """Return the row of the first clear stop of an instance, or of the widest one if none is clear.

    The first one is kept since what is still unseen may be in the way of a later one.
    """
    kept = m * STOPS
    for i in range(m * STOPS + 1, m * STOPS + STOPS):
        if stop_clearance[b, kept] < demanded and stop_clearance[b, i] > stop_clearance[b, kept]:
            kept = i
    return kept


@wp.func
def has_clear_stop(b: int, m: int, is_admissible: int, views: Any, c: Any) -> int:
    """Return 1 if instance m has a clear stop, beyond which it need not be clear; see `Hooks.admissible`."""
    if c.prove_stop == 0:
        return is_admissible
    clearances = views.stop_proof.static_clearance
    demanded = clear_stop(clearances[b, m, clearances.shape[2] - 1], c)
    kept = stop_to_keep(b, m, demanded, views.stop_proof.stop_clearance)
    return wp.where(views.stop_proof.stop_clearance[b, kept] >= demanded, 1, 0)


@wp.func
def fly_proven_stop(b: int, f: Fallback, views: Any, c: Any) -> Fallback:
    """Fly the stop that was proven last on while it is clear of static obstacles, see `Hooks.fallback`.

    If neither it nor a braking candidate is, fly what keeps the largest clearance, which may be an instance with its
    widest stop. A braking candidate that evades dynamic obstacles comes before a proven stop that does not.
    """
    if c.prove_stop == 0 or f.status != _NO_SAFE_CANDIDATE:
        return f
    clearances = views.stop_proof.static_clearance
    demanded = clear_stop(clearances[b, 0, clearances.shape[2] - 1], c)
    if views.stop_proof.stop_ready[b] != 0:
        row = views.stop_proof.least_clearance.shape[1] - 1
        d = views.stop_proof.least_clearance[b, row]
        is_clear = d[1] >= demanded
        better = d[0] > f.clearance[0]
        if is_clear != (f.clearance[1] >= demanded):
            better = is_clear
        if better or (is_clear and (f.clearance[0] < demanded or d[0] >= demanded)):
            f.flown = row
            f.clearance = d
    if f.clearance[1] < demanded and c.prefer_safe != 0:
        widest = wp.max(f.clearance[0], _WIDEST * demanded)
        for i in range(views.stop_proof.stop_clearance.shape[1]):
            if views.stop_proof.stop_clearance[b, i] > widest:
                widest = views.stop_proof.stop_clearance[b, i]
                f.flown = i // STOPS
    return f
