"""What the kernels of a planner are composed of: a vehicle model, stages, and the sums of the cost terms."""

# Postponed annotations are left out: Warp functions need the types themselves.

import functools
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import warp as wp

from aero_planner import registry
from aero_planner.config import PlannerConfig
from aero_planner.costs.cost_term import CostTerm, End, Step
from aero_planner.costs.terms import TERMS
from aero_planner.device.hook_records import Estimate, Fallback, Spread
from aero_planner.models.vehicle_model import VehicleModel
from aero_planner.stage import Hooks, Stage

wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True, eq=False)
class Composition:
    """Model, stages and terms, and the functions that kernels call. Equal structures share one composition.

    Attributes:
        model, stages, terms: what the planner is composed of.
        Views: Warp struct of the views of the stages, by name.
        hooks: each hook of all stages, one after another; one that changes nothing where no stage has it.
        running1: (s: Step, c) -> sum of the running terms of S1.
        goal: the same for those of J_goal.
        running2: the same for the other ones of S2.
        obstacle: (d, c) -> J_col.
        terminal1, terminal2: (e: End, views, c) -> sum of the terminal terms of S1, of S2.
    """

    model: VehicleModel
    stages: tuple[Stage, ...]
    terms: tuple[CostTerm, ...]
    Views: Any
    hooks: Hooks
    running1: wp.Function
    goal: wp.Function
    running2: wp.Function
    obstacle: wp.Function
    terminal1: wp.Function
    terminal2: wp.Function

    @classmethod
    def of(cls, config: PlannerConfig) -> "Composition":
        """Return the composition for the structure of a configuration."""
        return _compose(config.vehicle.model, config.stages.names)

    @property
    def stopping_rows(self) -> int:
        """Number of rows that stages append to the candidates that stop."""
        return sum(stage.stopping_rows for stage in self.stages)


@functools.cache
def _compose(model: str, stage_names: tuple[str, ...]) -> Composition:
    stages = tuple(registry.load_stage(name) for name in stage_names)
    brought = tuple(registry.load("cost_terms", name) for name in registry.names("cost_terms"))
    known = (*TERMS, *(term for stage in stages for term in stage.terms), *brought)
    terms = tuple(term for term in known if term.model in ("", model))
    viewed = {stage.name: stage.view for stage in stages if stage.view is not None}
    annotations = viewed or {"none": wp.int32}  # a struct has at least one field
    names = {"__annotations__": annotations, "__module__": __name__}
    return Composition(
        model=registry.load("models", model),
        stages=stages,
        terms=terms,
        Views=wp.struct(type("Views", (), names)),
        hooks=Hooks(**{name: _chain(name, stages) for name in _SAME}),
        running1=_sum(_plus_running, _no_running, (t.running for t in terms if t.in_stage1)),
        goal=_sum(_plus_running, _no_running, (t.running for t in terms if t.sum == "J_goal")),
        running2=_sum(_plus_running, _no_running, (t.running for t in terms if t.in_stage2 and t.sum != "J_goal")),
        obstacle=_sum(_plus_obstacle, _no_obstacle, (t.obstacle for t in terms)),
        terminal1=_sum(_plus_terminal, _no_terminal, (t.terminal for t in terms if t.in_stage1)),
        terminal2=_sum(_plus_terminal, _no_terminal, (t.terminal for t in terms if t.in_stage2)),
    )


def _sum(plus: Callable[[Any, Any], Any], zero: Any, functions: Iterable[Any]) -> Any:
    """Return the function that adds up `functions`, leaving out None."""
    present = [function for function in functions if function is not None]
    return functools.reduce(plus, present) if present else zero


def _chain(hook: str, stages: Iterable[Stage]) -> Any:
    """Return the function that calls a hook of all stages, each with the result of the one before."""
    present = [function for stage in stages if (function := getattr(stage.hooks, hook)) is not None]
    return functools.reduce(_THEN[hook], present) if present else _SAME[hook]


@wp.func
def _no_running(s: Step, c: Any) -> float:
    return 0.0


def _plus_running(first: Any, second: Any) -> Any:
    @wp.func
    def plus(s: Step, c: Any) -> float:
        return first(s, c) + second(s, c)

    return plus


@wp.func
def _no_obstacle(d: float, c: Any) -> float:
    return 0.0


def _plus_obstacle(first: Any, second: Any) -> Any:
    @wp.func
    def plus(d: float, c: Any) -> float:
        return first(d, c) + second(d, c)

    return plus


@wp.func
def _no_terminal(e: End, views: Any, c: Any) -> float:
    return 0.0


def _plus_terminal(first: Any, second: Any) -> Any:
    @wp.func
    def plus(e: End, views: Any, c: Any) -> float:
        return first(e, views, c) + second(e, views, c)

    return plus


@wp.func
def _same_estimate(b: int, e: Estimate, views: Any, c: Any) -> Estimate:
    return e


def _then_estimate(first: Any, second: Any) -> Any:
    @wp.func
    def then(b: int, e: Estimate, views: Any, c: Any) -> Estimate:
        return second(b, first(b, e, views, c), views, c)

    return then


@wp.func
def _same_spread(b: int, s: Spread, views: Any, c: Any) -> Spread:
    return s


def _then_spread(first: Any, second: Any) -> Any:
    @wp.func
    def then(b: int, s: Spread, views: Any, c: Any) -> Spread:
        return second(b, first(b, s, views, c), views, c)

    return then


@wp.func
def _same_turn(rate: float, q: wp.vec4, along: wp.vec3, otherwise: float, views: Any, c: Any) -> float:
    return rate


def _then_turn(first: Any, second: Any) -> Any:
    @wp.func
    def then(rate: float, q: wp.vec4, along: wp.vec3, otherwise: float, views: Any, c: Any) -> float:
        return second(first(rate, q, along, otherwise, views, c), q, along, otherwise, views, c)

    return then


@wp.func
def _no_ghost(b: int, x: wp.vec3, time: wp.float64, views: Any, c: Any) -> int:
    return 0


def _or_ghost(first: Any, second: Any) -> Any:
    @wp.func
    def either(b: int, x: wp.vec3, time: wp.float64, views: Any, c: Any) -> int:
        return wp.max(first(b, x, time, views, c), second(b, x, time, views, c))

    return either


@wp.func
def _same_clearance(d: float, x: wp.vec3, time: float, b: int, views: Any, c: Any) -> float:
    return d


def _then_clearance(first: Any, second: Any) -> Any:
    @wp.func
    def then(d: float, x: wp.vec3, time: float, b: int, views: Any, c: Any) -> float:
        return second(first(d, x, time, b, views, c), x, time, b, views, c)

    return then


@wp.func
def _same_admissible(b: int, m: int, is_admissible: int, views: Any, c: Any) -> int:
    return is_admissible


def _then_admissible(first: Any, second: Any) -> Any:
    @wp.func
    def then(b: int, m: int, is_admissible: int, views: Any, c: Any) -> int:
        return second(b, m, first(b, m, is_admissible, views, c), views, c)

    return then


@wp.func
def _same_fallback(b: int, f: Fallback, views: Any, c: Any) -> Fallback:
    return f


def _then_fallback(first: Any, second: Any) -> Any:
    @wp.func
    def then(b: int, f: Fallback, views: Any, c: Any) -> Fallback:
        return second(b, first(b, f, views, c), views, c)

    return then


_SAME: dict[str, wp.Function] = {
    "estimate": _same_estimate,
    "spread": _same_spread,
    "turn": _same_turn,
    "ghost": _no_ghost,
    "clearance": _same_clearance,
    "admissible": _same_admissible,
    "fallback": _same_fallback,
}
_THEN = {
    "estimate": _then_estimate,
    "spread": _then_spread,
    "turn": _then_turn,
    "ghost": _or_ghost,
    "clearance": _then_clearance,
    "admissible": _then_admissible,
    "fallback": _then_fallback,
}
