"""Every cost term by itself, for explanations: the functions whose sums are S1 and S2, evaluated one by one."""

# Postponed annotations are left out: kernels made for a composition refer to local types.

import functools
from collections.abc import Sequence
from typing import Any

import warp as wp

from aero_planner.composition import Composition
from aero_planner.costs.cost_term import CostTerm, End, Step
from aero_planner.device.kernel_tuning import KernelTuning
from aero_planner.device.params import Params
from aero_planner.device.records import Problem, Start, grid_struct
from aero_planner.kernels.clearance import above_ground, cell_size, clearance_at, query_limit
from aero_planner.kernels.mppi import PROBES, probe_position

wp.set_module_options({"enable_backward": False})


@wp.struct
class TermValues:
    """Terms of n rollouts; T is the number of terms."""

    values: wp.array3d(dtype=float)  # [n, N, T]; terminal terms count at the last step
    positions: wp.array2d(dtype=wp.vec3)  # [n, N], states after each control, world frame [m]
    clearance: wp.array2d(dtype=float)  # [n, N], distance to the nearest obstacle, truncated where it costs nothing [m]


@functools.cache
def write_terms(tuning: KernelTuning, composition: Composition) -> wp.Kernel:
    """Return the kernel that writes every term of some rollouts."""
    clearance_of = clearance_at(tuning.points_per_pack, 1)
    Grid: Any = grid_struct(tuning.points_per_pack)
    Views, dynamic, model = composition.Views, composition.hooks.clearance, composition.model
    constants, step = model.constants, model.step
    write_step, write_end = _write_step(composition.terms), _write_end(composition.terms)

    @wp.kernel(module="unique", enable_backward=False)
    def write_terms(
        # problem
        problem: Problem,
        start: Start,
        # configuration
        params: wp.array(dtype=Params),
        previous_index: int,
        # in
        grid: Grid,
        views: Views,
        guides: wp.array3d(dtype=wp.vec3),
        rows: wp.array(dtype=wp.vec2i),
        controls: wp.array2d(dtype=wp.vec4),
        # out
        terms: TermValues,
    ):
        """Roll out controls [n, N] from the start of the plan, and write each term at each step.

        `rows` [n] are drone and instance of each rollout: the guide of that instance is tracked. Launched over [n].
        """
        n = wp.tid()
        b = rows[n][0]
        m = rows[n][1]
        c = params[b]
        steps = controls.shape[1]
        p = start.position[b]
        v = start.velocity[b]
        q = start.quaternion[b]
        acting = start.control[b]
        k = constants(start.disturbance[b], start.drag[b], c.dt, c)
        s = Step()
        s.last = steps - 1
        s.is_guided = wp.where(m == previous_index, 0, 1)
        s.p_goal = problem.goal[b]
        s.v_goal = start.goal_velocity[b]
        s.q_goal = start.goal_quaternion[b]
        s.u = start.command[b]
        center = problem.position[b]
        size = cell_size(problem.velocity[b], c)
        for t in range(steps):
            s.t = t
            s.u_before = s.u
            s.u = controls[n, t]
            s.p_guide = guides[b, m, t + 1]
            p, v, q, acting = step(p, v, q, acting, s.u, k)
            s.p = p
            s.v = v
            s.q = q
            d = clearance_of(p, query_limit(t, steps, problem.velocity[b], c), b, 0, center, size, grid)
            d = above_ground(d, p, problem.ground_height[b], c)
            d = dynamic(d, p, float(t + 1) * c.dt, b, views, c)
            terms.positions[n, t] = p
            terms.clearance[n, t] = d
            write_step(n, s, d, c, terms.values)
        e = End()
        e.b = b
        e.p = p
        e.p_goal = s.p_goal
        e.blocked = 0.0
        if c.q_blocked > 0.0:
            for j in range(PROBES):
                x = probe_position(p, e.p_goal, j, c)
                d = clearance_of(x, query_limit(steps, steps, problem.velocity[b], c), b, 0, center, size, grid)
                if above_ground(d, x, problem.ground_height[b], c) < c.distance_min:
                    e.blocked += 1.0 / float(PROBES)
        write_end(n, steps - 1, e, views, c, terms.values)

    return tuning.set_options(write_terms)


def _write_step(terms: Sequence[CostTerm]) -> wp.Function:
    """Return the function (n, s, d, c, values) that writes all running and obstacle terms of a step."""
    write: Any = _nothing_at_step
    for i, term in enumerate(terms):
        if term.running is not None:
            write = _then_running(write, term.running, i)
        if term.obstacle is not None:
            write = _then_obstacle(write, term.obstacle, i)
    return write


def _write_end(terms: Sequence[CostTerm]) -> wp.Function:
    """Return the function (n, t, e, views, c, values) that writes all terminal terms."""
    write: Any = _nothing_at_end
    for i, term in enumerate(terms):
        if term.terminal is not None:
            write = _then_terminal(write, term.terminal, i)
    return write


@wp.func
def _nothing_at_step(n: int, s: Step, d: float, c: Any, values: wp.array3d(dtype=float)):
    pass


def _then_running(first: Any, term: Any, index: int) -> Any:
    INDEX = wp.constant(index)

    @wp.func
    def then(n: int, s: Step, d: float, c: Any, values: wp.array3d(dtype=float)):
        first(n, s, d, c, values)
        values[n, s.t, INDEX] = values[n, s.t, INDEX] + term(s, c)

    return then


def _then_obstacle(first: Any, term: Any, index: int) -> Any:
    INDEX = wp.constant(index)

    @wp.func
    def then(n: int, s: Step, d: float, c: Any, values: wp.array3d(dtype=float)):
        first(n, s, d, c, values)
        values[n, s.t, INDEX] = values[n, s.t, INDEX] + term(d, c)

    return then


@wp.func
def _nothing_at_end(n: int, t: int, e: End, views: Any, c: Any, values: wp.array3d(dtype=float)):
    pass


def _then_terminal(first: Any, term: Any, index: int) -> Any:
    INDEX = wp.constant(index)

    @wp.func
    def then(n: int, t: int, e: End, views: Any, c: Any, values: wp.array3d(dtype=float)):
        first(n, t, e, views, c, values)
        values[n, t, INDEX] = values[n, t, INDEX] + term(e, views, c)

    return then
