"""Which parameters change the plan of one tick, each a little."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from aero_planner import PlannerConfig
from aero_planner.config import ParameterInfo, Value
from aero_viz.errors import UserError
from aero_viz.explain.evidence import Replanner
from aero_viz.planners.plan import Plan
from aero_viz.session.frame import Frame

SHARE = 0.2
"""Share of its value by which a parameter is changed, down and up."""
_VISIBLE = 0.005
"""Smallest change of the clearance that counts [m]."""


@dataclass(frozen=True)
class Effect:
    """What one change does."""

    value: Value
    """The other value of the parameter."""
    choice: str
    """Instance and kind that are chosen with it."""
    is_other: bool
    """True if that is another choice."""
    clearance: float
    """Change of the clearance of the plan [m]."""

    @property
    def is_visible(self) -> bool:
        """True if the choice or the clearance changes."""
        return self.is_other or abs(self.clearance) >= _VISIBLE


@dataclass(frozen=True)
class Sensitivity:
    """Effects of one parameter; None where the other value is not allowed or the same."""

    info: ParameterInfo
    less: Effect | None
    more: Effect | None

    @property
    def rank(self) -> tuple[bool, float]:
        """What the effects are sorted by: another choice first, then the larger change of the clearance."""
        effects = [effect for effect in (self.less, self.more) if effect is not None]
        return any(e.is_other for e in effects), max((abs(e.clearance) for e in effects), default=0.0)

    @property
    def is_visible(self) -> bool:
        """True if one of the changes changes the choice or the clearance."""
        return any(effect is not None and effect.is_visible for effect in (self.less, self.more))


def sensitivity(replan: Replanner, frame: Frame, *, progress: Callable[[int, int], bool]) -> list[Sensitivity] | None:
    """Return the effects of every live parameter on the plan of a frame, the strongest first.

    The plans follow one another on one planner with the history of the tick: a batch would take no sweeps, and lose the
    motion of obstacles.

    Args:
        replan: planner for the plans.
        frame: frame of AERO-MPPI.
        progress: called with the number of plans so far and of all plans; returns False to stop.

    Returns:
        None if it was stopped.

    Raises:
        UserError: the planner is another one, or the tick cannot be planned again.
    """
    config = frame.config
    if not isinstance(config, PlannerConfig):
        raise UserError("Sensitivity is known of AERO-MPPI alone: it needs the history that its plans build on.")
    base, variants = replan.plan(frame), list(_variants(config))
    found: list[Sensitivity] = []
    for info, configs in variants:
        effects: list[Effect | None] = []
        for other in configs:
            if not progress(2 * len(found) + len(effects), 2 * len(variants)):
                return None
            effects.append(None if other is None else _effect(replan, frame, other, info, base))
        found.append(Sensitivity(info, *effects))
    return sorted(found, key=lambda one: one.rank, reverse=True)


def _variants(config: PlannerConfig) -> Iterator[tuple[ParameterInfo, Sequence[PlannerConfig | None]]]:
    """Yield each live number with an effect, and the configurations with less and with more of it."""
    stages = config.find("stages.active").items or ()
    for info in config.parameters():
        is_active = info.section not in stages or info.section in config.stages.names
        if info.live and info.is_number and is_active and config.get(info.path):
            yield info, [_scaled(config, info, 1.0 + share) for share in (-SHARE, SHARE)]


def _scaled(config: PlannerConfig, info: ParameterInfo, factor: float) -> PlannerConfig | None:
    """Return the configuration with a parameter times a factor; None if that is refused or the same."""
    old = config.get(info.path)
    value = type(old)(min(max(float(f"{factor * float(old):.6g}"), info.low), info.high))
    try:
        return None if value == old else config.replace({info.path: value})
    except ValueError:
        return None


def _effect(replan: Replanner, frame: Frame, config: PlannerConfig, info: ParameterInfo, base: Plan) -> Effect:
    plan = replan.plan(dataclasses.replace(frame, config=config))
    choice, clearance = f"{plan.best} {plan.kinds[plan.best]}", _clearance(plan) - _clearance(base)
    return Effect(config.get(info.path), choice, plan.best != base.best, clearance)


def _clearance(plan: Plan) -> float:
    """Return the smallest clearance of the chosen candidate [m]."""
    return float(plan.clearance[plan.best].min())
