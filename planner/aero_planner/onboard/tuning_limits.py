"""Which of the planner's parameters may be changed in flight, and within which bounds: the text of `tuning.limits`."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace

from aero_planner.config import ParameterInfo, PlannerConfig, Value
from aero_planner.parameters import ContradictionError

_NUMBER = r"-?[0-9]+(?:\.[0-9]+)?(?:e-?[0-9]+)?"
_ITEM = rf"([a-z0-9_]+\.[a-z0-9_]+)(?: ({_NUMBER})\.\.({_NUMBER}))?"
TUNING_LIMITS = rf"none|{_ITEM}(?:, *{_ITEM})*"
"""Pattern of the text."""

_OF_THE_NODE = ("costs.use_ground", "partition.range_min", "unseen_space.view")
"""Live parameters that the node relies on. So it does on all of the vehicle's but the speed limit."""


def tunable_parameters(limits: str) -> Mapping[str, ParameterInfo]:
    """Return the parameters that a text allows to change, by path, each with the bounds of the text.

    Raises:
        ContradictionError: one of them is unknown, can't change in flight, or has no bounds or impossible ones.
    """
    found: dict[str, ParameterInfo] = {}
    for path, low, high in re.findall(_ITEM, limits):
        try:
            info = PlannerConfig.find(path)
        except ValueError as error:
            raise _refusal(str(error)) from None
        if not info.live:
            raise _refusal(f"{path} is structural; only live parameters can change in flight.")
        if path in _OF_THE_NODE or (info.section == "vehicle" and info.name != "speed_limit"):
            raise _refusal(f"the node itself relies on {path}, which can't change in flight.")
        if info.is_number != bool(low):
            example = f"{path} {info.low:g}..{info.high:g}" if info.is_number else path
            raise _refusal(f"{path} {'needs bounds' if info.is_number else 'has no bounds'}; write {example}.")
        if info.is_number:
            if not info.low <= float(low) < float(high) <= info.high:
                raise _refusal(f"{path} has the bounds {low}..{high}; they must rise, within {info.range}.")
            info = replace(info, low=float(low), high=float(high))
        found[info.path] = info
    return found


def check_limits(planner: PlannerConfig, limits: str) -> None:
    """Raise `ContradictionError`, a ValueError, if a text does not suit the planner's configuration."""
    for info in tunable_parameters(limits).values():
        try:
            info.check(planner.get(info.path))
        except ValueError as error:
            raise ContradictionError(
                f"{error} tuning.limits says so; it must include the value with which the node starts.",
                info.path, "tuning.limits",
            ) from None  # fmt: skip


def check_changes(changes: object, tunable: Mapping[str, ParameterInfo]) -> dict[str, Value]:
    """Return the values of a change that somebody asks for, by path.

    Raises:
        ValueError: it is malformed, or has a parameter or a value that is not allowed; says which.
    """
    if not isinstance(changes, dict) or not changes:
        raise ValueError("the change is malformed.")
    for path in changes:
        if path not in tunable:
            allowed = ", ".join(tunable) or "nothing"
            raise ValueError(f"{path!r:.80} can't be changed: tuning.limits of the node allows {allowed}.")
    return {path: tunable[path].check(value) for path, value in changes.items()}


def _refusal(reason: str) -> ContradictionError:
    return ContradictionError(f"tuning.limits: {reason}", "tuning.limits")
