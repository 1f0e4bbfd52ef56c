"""The interface of a stage: an option of the planner that owns its parameters, arrays, state, kernels and launches."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from aero_planner.config import PlannerConfig
from aero_planner.costs.cost_term import CostTerm

Launches = list[Callable[[], Any]]


@dataclass(frozen=True)
class Hooks:
    """Functions that a stage hands to the kernels of the core, each a `@wp.func` or None.

    `views` are the `view`s of all active stages, by the stages' names; c holds the live parameters. Annotate `views`
    with `typing.Any`. Where several stages have the same hook, each gets the result of the one before.

    Attributes:
        estimate: (b, e: Estimate, views, c) -> Estimate: the disturbance and drag that plans count on.
        spread: (b, s: Spread, views, c) -> Spread: the spacing of the anchors.
        turn: (rate, q, along, otherwise, views, c) -> float: the yaw rate [rad/s] with which a candidate turns that
            flies `along` (vec3, world frame) at the attitude q, where `otherwise` is the heading of the goal [rad].
        ghost: (b, x, time, views, c) -> int: 1 if an obstacle has left the point x [m] since it was measured, at a
            `time` (float64) [s], else 0.
        clearance: (d, x, time, b, views, c) -> the smaller of d [m] and the distance of x [m] from dynamic obstacles, a
            time [s] after the start of the plan.
        admissible: (b, m, is_admissible, views, c) -> int: whether instance m may be flown, 0 or 1.
        fallback: (b, f: Fallback, views, c) -> Fallback: what is flown if no instance is admissible.
    """

    estimate: Callable[..., Any] | None = None
    spread: Callable[..., Any] | None = None
    turn: Callable[..., Any] | None = None
    ghost: Callable[..., Any] | None = None
    clearance: Callable[..., Any] | None = None
    admissible: Callable[..., Any] | None = None
    fallback: Callable[..., Any] | None = None


@dataclass(frozen=True, eq=False)
class Stage:
    """A stage.

    A stage that is not active records nothing and allocates nothing, and every plan is bit for bit as without it.

    Args:
        name: its name in `aero_planner.registry`, that of its parameter section if it has one.
        label: for people.
        arrays: dataclass that declares its device arrays, see `array_memory.array`; fields with `kept` are its state.
        outputs: dataclass that declares the arrays that are copied to the host with each plan.
        reports: fields of a `Plan` that it makes, each a function of the planner's outputs: (values, config, batched).
            `values` is a record of the arrays of all outputs by name, with a leading axis B.
        symbols: (rows, columns of fine cells) -> sizes by symbols that the shapes of its arrays use besides the core's.
        view: Warp struct that hooks and cost terms read; its fields have the names of arrays of the stage, or of the
            core.
        hooks: functions for the kernels of the core.
        terms: cost terms.
        stopping_rows: number of rows of candidates that it appends to those that stop.
        launches: by place of the pipeline, the function of a `Recorder` that records its launches there. The places:
            "arrival": a sweep arrives, see `kernels.sweep_change`, before a plan reads it;
            "start": after the state is predicted, before the anchors are placed;
            "beside": beside everything up to the first clearance query;
            "cells": after the fine cells are known, before the points are sorted into the grid;
            "guides": beside the guides, to write those of its own rows;
            "rollouts": after the Stage II rollouts, beside their evaluation;
            "proof": after the evaluation, beside the sum of S2, before the selection;
            "end": after the selection.
            Each returns steps that follow each other: chunks of a step may run at the same time, launches of a chunk
            run one after another.
    """

    name: str
    label: str
    arrays: type | None = None
    outputs: type | None = None
    reports: Mapping[str, Callable[[Any, PlannerConfig, bool], Any]] = field(default_factory=dict)
    symbols: Callable[[int, int], dict[str, int]] | None = None
    view: Any = None
    hooks: Hooks = field(default_factory=Hooks)
    terms: tuple[CostTerm, ...] = ()
    stopping_rows: int = 0
    launches: Mapping[str, Callable[[Any], list[list[Launches]]]] = field(default_factory=dict)
