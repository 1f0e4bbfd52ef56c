"""What a planner is made of besides the paper: stages, cost terms and vehicle models, by name.

Those that ship are listed here. Another distribution adds its own by entry points in the groups `aero_planner.stages`,
`aero_planner.cost_terms` and `aero_planner.models`, a script by `add`. Everything is loaded when it is first needed:
the parameters when the configuration is imported, kernels when a planner is made. What an entry point brings is
imported with the configuration; a part that cannot be imported is named and left out.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import sys
from importlib import metadata
from typing import Any, Literal, NamedTuple

from aero_planner.parameters import ParameterSection, log_warning

Kind = Literal["stages", "cost_terms", "models"]


class PlugIn(NamedTuple):
    """A part that an installed distribution brings by an entry point."""

    name: str
    place: str
    """"module:attribute", or "module"."""
    distribution: str
    """Name and version."""


STAGES = {
    "unseen_space": "aero_planner.stages.unseen_space",
    "way_out": "aero_planner.stages.way_out",
    "stop_proof": "aero_planner.stages.stop_proof",
    "disturbance": "aero_planner.stages.disturbance",
    "memory": "aero_planner.stages.memory",
    "stray_points": "aero_planner.stages.stray_points",
    "moving_obstacles": "aero_planner.stages.moving_obstacles",
}
"""Package of each stage, in the order in which stages act at one place of the pipeline. It has a module `stage`
with `STAGE`, a `Stage`, and, if it has parameters, a module `parameters` with `Parameters`, a `ParameterSection` of the
stage's name."""

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
    """Return the names of all stages, cost terms or models: shipped, of entry points, and added."""
    brought = (plug_in.name for plug_in, problem in checked(kind) if not problem)
    return (*_SHIPPED[kind], *brought, *_added[kind])


def label(kind: Kind) -> str:
    """Return what one part of a kind is called, such as "cost term"."""
    return kind.replace("_", " ").removesuffix("s")


@functools.cache
def checked(kind: Kind) -> tuple[tuple[PlugIn, str], ...]:
    """Return what entry points bring, each with the reason why it is left out; that is empty for what is used."""
    taken, found = {*_SHIPPED[kind], *_added[kind]}, []
    for plug_in in plug_ins(f"aero_planner.{kind}"):
        problem = "there is one of that name already" if plug_in.name in taken else _problem(kind, plug_in.place)
        if problem:
            log_warning("The %s %s of %s is left out: %s.", label(kind), plug_in.name, plug_in.distribution, problem)
        else:
            taken.add(plug_in.name)
        found.append((plug_in, problem))
    return tuple(found)


def _problem(kind: Kind, place: str) -> str:
    """Return why a part cannot be imported."""
    try:
        part = find_attribute(place)
        if kind == "stages":
            _parameters_of(part.__name__)
    except (Exception, SystemExit) as error:  # whatever a brought module raises
        return " ".join(f"{type(error).__name__}: {error}".split()).rstrip(".")
    return ""


def plug_ins(group: str) -> list[PlugIn]:
    """Return what entry points of a group bring, without importing it."""
    found = []
    for entry in _entry_points().select(group=group):
        owner = getattr(entry, "dist", None)
        distribution = "an unnamed distribution" if owner is None else f"{owner.metadata['Name']} {owner.version}"
        found.append(PlugIn(entry.name, entry.value.partition("[")[0].strip(), distribution))
    return sorted(found)


@functools.cache
def _entry_points() -> Any:
    """Return the entry points of all distributions; reading them takes longer than everything else here."""
    return metadata.entry_points()


def find_attribute(place: str) -> Any:
    """Import and return what lies at a place, "module:attribute" or "module"."""
    module, _, attribute = place.partition(":")
    found = importlib.import_module(module)
    for part in filter(None, attribute.split(".")):
        found = getattr(found, part)
    return found


@functools.cache
def load(kind: Kind, name: str) -> Any:
    """Return a cost term, a vehicle model, or the package of a stage."""
    places = {plug_in.name: plug_in.place for plug_in, problem in checked(kind) if not problem}
    part = (places | _SHIPPED[kind] | _added[kind])[name]
    return find_attribute(part) if isinstance(part, str) else part


def load_stage(name: str) -> Any:
    """Return the `Stage` of this name, with its kernels."""
    return importlib.import_module(f"{load('stages', name).__name__}.stage").STAGE


def _parameters_of(package: str) -> type[ParameterSection] | None:
    """Return the parameter section of a stage, None if it has none."""
    if importlib.util.find_spec(f"{package}.parameters") is None:
        return None
    return importlib.import_module(f"{package}.parameters").Parameters


def added_sections() -> dict[str, type[ParameterSection]]:
    """Return the parameter sections of all stages, and of cost terms and models that bring one, by name."""
    stages = [section for name in names("stages") if (section := _parameters_of(load("stages", name).__name__))]
    brought = [
        part.parameters
        for kind in ("cost_terms", "models")
        for name in names(kind)
        if name not in _SHIPPED[kind] and (part := load(kind, name)).parameters is not None
    ]
    return {section.section: section for section in (*stages, *brought)}
