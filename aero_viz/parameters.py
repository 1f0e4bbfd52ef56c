"""Parameters of the simulation: fields with default, unit, bounds and help, made as those of the planner are.

A dataclass whose fields come from `aero_planner.config.parameter` is the one home of what is known of them: it checks
its own values, and flags and documentation derive from it.
"""

from __future__ import annotations

import dataclasses
from typing import Any

from aero_planner.config.parameter import ParameterInfo

__all__ = ["check_parameters", "parameters_of"]


def parameters_of(kind: type, section: str) -> tuple[ParameterInfo, ...]:
    """Return the fields of a dataclass that are parameters, in its order; `section` precedes their names."""
    return tuple(
        ParameterInfo(section=section, name=f.name, default=f.default, **f.metadata)  # type: ignore[arg-type]
        for f in dataclasses.fields(kind)
        if f.metadata
    )


def check_parameters(instance: Any, section: str) -> None:
    """Give every parameter of a dataclass in the making its type.

    Raises:
        ValueError: a value has the wrong type or lies outside its bounds; names parameter, value and range.
    """
    for info in parameters_of(type(instance), section):
        object.__setattr__(instance, info.name, info.check(getattr(instance, info.name)))
