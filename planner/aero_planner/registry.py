"""What a planner is made of besides the paper: stages, cost terms and vehicle models, by name.

Those that ship are listed here. Another distribution adds its own by entry points in the groups `aero_planner.stages`,
`aero_planner.cost_terms` and `aero_planner.models`, a script by `add`. Everything is loaded when it is first needed:
the parameters when the configuration is imported, kernels when a planner is made.
"""

from __future__ import annotations

import functools
import importlib
import sys
from importlib import metadata
from typing import Any, Literal

from aero_planner.parameters import ParameterSection

Kind = Literal["stages", "cost_terms", "models"]

STAGES = {
    "unseen_space": "aero_planner.stages.unseen_space",
    "moving_obstacles": "aero_planner.stages.moving_obstacles",
    "way_out": "aero_planner.stages.way_out",
    "stop_proof": "aero_planner.stages.stop_proof",
    "disturbance": "aero_planner.stages.disturbance",
    "memory": "aero_planner.stages.memory",
}
"""Package of each stage, in the order in which stages act at one place of the pipeline. It has a module `parameters`
with `Parameters`, a `ParameterSection` of the stage's name, and a module `stage` with `STAGE`, a `Stage`."""

MODELS = {"ctbr": "aero_planner.models.ctbr:CTBR", "acceleration": "aero_planner.models.acceleration:ACCELERATION"}
"""Module and name of each `VehicleModel`."""

_SHIPPED: dict[Kind, dict[str, Any]] = {"stages": STAGES, "cost_terms": {}, "models": MODELS}
_added: dict[Kind, dict[str, Any]] = {"stages": {}, "cost_terms": {}, "models": {}}


def add(kind: Kind, name: str, part: Any) -> None:
    """Add a stage, a cost term or a vehicle model to all planners of this process.

    Args:
        kind: "stages", "cost_terms" or "models".
        name: its name, which no other one has.
        part: what an entry point would refer to: the package of a stage, a `CostTerm`, or a `VehicleModel`; or its name
            "module:attribute".

    Raises:
        ValueError: the name is taken, or it is too late, since the configuration has been imported.
    """
    if "aero_planner.config.planner_config" in sys.modules:
        raise ValueError(f"{name!r} comes too late: add it before anything imports aero_planner.config or Planner.")
    if name in _SHIPPED[kind] or name in _added[kind]:
        raise ValueError(f"{kind} has {name!r} already; give another name.")
    _added[kind][name] = part


@functools.cache
def names(kind: Kind) -> tuple[str, ...]:
    """Return the names of all stages, cost terms or models: shipped, added, and of entry points."""
    found = {entry.name: entry.value for entry in _entry_points().select(group=f"aero_planner.{kind}")}
    _added[kind] = found | _added[kind]
    return (*_SHIPPED[kind], *(name for name in _added[kind] if name not in _SHIPPED[kind]))


@functools.cache
def _entry_points() -> Any:
    """Return the entry points of all distributions; reading them takes longer than everything else here."""
    return metadata.entry_points()


@functools.cache
def load(kind: Kind, name: str) -> Any:
    """Return a cost term, a vehicle model, or the package of a stage."""
    part = (_SHIPPED[kind] | _added[kind])[name]
    if not isinstance(part, str):
        return part
    module, _, attribute = part.partition(":")
    loaded = importlib.import_module(module)
    return getattr(loaded, attribute) if attribute else loaded


def load_stage(name: str) -> Any:
    """Return the `Stage` of this name, with its kernels."""
    return importlib.import_module(f"{load('stages', name).__name__}.stage").STAGE


def added_sections() -> dict[str, type[ParameterSection]]:
    """Return the parameter sections of all stages, and of cost terms and models that bring one, by name."""
    packages = [load("stages", name).__name__ for name in names("stages")]
    stages = [importlib.import_module(f"{package}.parameters").Parameters for package in packages]
    brought = [
        part.parameters
        for kind in ("cost_terms", "models")
        for name in names(kind)
        if name in _added[kind] and (part := load(kind, name)).parameters is not None
    ]
    return {section.section: section for section in (*stages, *brought)}
