"""Planners by name: those that ship, those of entry points, and any class as "module:Class"."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

from aero_planner.config import DroneConfig, PlannerConfig
from aero_viz.errors import UserError
from aero_viz.planners.planner import Planner
from aero_viz.registry import Registry

_used: set[str] = set()
"""What configurations call the planners that were loaded."""


def _accept(name: str, found: Any) -> type[Planner]:
    if not (isinstance(found, type) and issubclass(found, Planner)):
        raise UserError(f"{name} is not a planner; derive it from aero_viz.planners.Planner.")
    return found


PLANNERS: Registry[type[Planner]] = Registry(
    "planner",
    "aero_viz.planners",
    {
        "aero_mppi": "aero_viz.planners.aero_mppi:AeroMppi",
        "single_mppi": "aero_viz.planners.single_mppi:SingleMppi",
        "primitives": "aero_viz.planners.primitives:Primitives",
        "ros": "aero_viz.ros.simulator:RosPlanner",
    },
    _accept,
    others="module:Class, or connect:ADDRESS",
)
"""All planners by name."""


@functools.cache
def load(name: str) -> type[Planner]:
    """Return the planner with a name, at a place "module:Class", or in another process, "connect:ADDRESS".

    A module may lie in the current folder.

    Raises:
        UserError: there is no such planner, or it cannot be imported; says why.
    """
    if name.startswith("connect:"):
        from aero_viz.planners.remote import planner_at

        found = planner_at(name.removeprefix("connect:"))
    else:
        found = PLANNERS.load(name)
    _used.update((name, found.Config.planner))
    return found


def load_known(name: str) -> type[Planner]:
    """Return the planner that a file names. Files may name registered planners, and those that this process uses.

    Raises:
        UserError: it is neither: a file may not choose which modules are imported.
    """
    if name not in _used and PLANNERS.name_of(name) not in PLANNERS:
        raise UserError(f"The file is for the planner {name}, which is not registered here; add --planner {name}.")
    return load(name)


def config_type(planner: str, *, of_file: bool = False) -> type[DroneConfig]:
    """Return the class of a planner's configuration; that of AERO-MPPI without an import of its kernels.

    Args:
        planner: name of the planner.
        of_file: True if a file names it, see `load_known`.

    Raises:
        UserError: there is no such planner.
    """
    if planner == PlannerConfig.planner:
        return PlannerConfig
    return (load_known if of_file else load)(planner).Config


def name_of(config: DroneConfig | type[DroneConfig]) -> str:
    """Return the name of the planner that a configuration is for, or its place "module:Class"."""
    return PLANNERS.name_of(config.planner)


def make(config: DroneConfig, *, device: str = "cpu", seed: int = 0) -> Planner:
    """Return a new planner with a configuration.

    Raises:
        UserError: the planner cannot be imported.
    """
    return load(config.planner)(config, device=device, seed=seed)


def is_aero_mppi(config: DroneConfig) -> bool:
    """Return True if the planner of a configuration is that of `aero_planner`, which also flies batches on the device.

    Raises:
        UserError: the planner cannot be imported.
    """
    from aero_viz.planners.aero_mppi import AeroMppi

    return isinstance(config, PlannerConfig) and load(config.planner).plan is AeroMppi.plan


def planner_entry(config: DroneConfig) -> dict[str, str]:
    """Return what a file says of the planner of a configuration besides "config"; nothing for AERO-MPPI."""
    return {} if config.planner == PlannerConfig.planner else {"planner": config.planner}


def config_of_entry(entries: Mapping[str, Any]) -> DroneConfig:
    """Return the configuration in a file, from its values at "config" and its planner at "planner".

    Raises:
        UserError: the planner cannot be imported.
        ValueError: a parameter is unknown, or a value out of bounds.
    """
    planner = entries.get("planner", PlannerConfig.planner)
    return config_type(planner, of_file=True).from_dict(entries["config"])
