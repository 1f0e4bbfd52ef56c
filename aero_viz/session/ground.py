"""What the planner is told of flat ground, by `costs.floor`; the literal paper is told nothing.

A Mid-360 does not see what is below it, and a slow drone that seeks free space sinks.
"""

from __future__ import annotations

from aero_planner import PlannerConfig
from aero_planner.config import find_parameter

__all__ = ["move_ground", "preset_above"]

_FLOOR = find_parameter("costs.floor")


def preset_above(name: str, ground: float | None) -> PlannerConfig:
    """Return a preset that is told of flat ground at this height [m], None for none; the paper's stays as it is.

    Raises:
        ValueError: no such preset; the message lists them.
    """
    config = PlannerConfig.preset(name)
    return config if name == "paper" else config.replace({_FLOOR.path: _floor(ground)})


def move_ground(config: PlannerConfig, before: float | None, after: float | None) -> PlannerConfig:
    """Return the configuration above other ground [m], None for none; a floor that is not the one told stays."""
    if config.costs.floor != _floor(before) or config == PlannerConfig.preset("paper"):
        return config
    return config.replace({_FLOOR.path: _floor(after)})


def _floor(ground: float | None) -> float:
    return float(_FLOOR.default) if ground is None else min(max(ground, _FLOOR.low), _FLOOR.high)
