"""What a cost term is, and what it sees of a rollout."""

# Postponed annotations are left out: Warp structs need the types themselves.

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import warp as wp

from aero_planner.parameters import ParameterSection


@wp.struct
class Step:
    """One time step of a rollout: the state after control t, world frame, SI units."""

    t: int  # 0 .. N-1
    last: int  # N - 1
    is_guided: int  # 1 if the instance follows a guide, 0 for the previous plan
    p: wp.vec3  # position
    v: wp.vec3  # velocity
    q: wp.vec4  # attitude w x y z, body to world
    u: wp.vec4  # control t
    u_before: wp.vec4  # control t - 1; for t = 0 the one that is commanded at the start
    p_guide: wp.vec3  # position of the guide
    p_goal: wp.vec3
    v_goal: wp.vec3
    q_goal: wp.vec4


@wp.struct
class End:
    """The end of a rollout, world frame, SI units."""

    b: int  # drone
    p: wp.vec3  # final position
    p_goal: wp.vec3
    blocked: float  # share of the straight path to the goal that is blocked, as far as the look-ahead distance


@dataclass(frozen=True, eq=False)
class CostTerm:
    """One term of S1 or S2, as `@wp.func`s of a time step, of a clearance, or of the end of a rollout.

    c holds the live parameters by name, such as c.q_track; outside the package it is annotated with `typing.Any`.

    Args:
        name: name of the term, also of its slider's heading.
        label: what is shown in bars and cards.
        sum: sum to which it belongs, such as "J_goal".
        in_stage1, in_stage2: True if it is a part of S1, of S2.
        running: (s: Step, c) -> cost of a time step.
        obstacle: (d, c) -> cost of a time step with clearance d [m].
        terminal: (e: End, views, c) -> cost of the end. `views` are the arrays of the active stages.
        parameters: section of the term's own parameters, such as its weight; None if it has none.
        model: vehicle model whose controls the term reads; others do without it. Empty for all.
    """

    name: str
    label: str
    sum: str = ""
    in_stage1: bool = True
    in_stage2: bool = True
    running: Callable[..., Any] | None = None
    obstacle: Callable[..., Any] | None = None
    terminal: Callable[..., Any] | None = None
    parameters: type[ParameterSection] | None = None
    model: str = ""
