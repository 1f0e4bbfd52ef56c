"""Checks of this machine: versions, devices, and the browser."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import sys
from dataclasses import dataclass
from typing import Any, get_args

from aero_planner import registry
from aero_planner.check_report import Check, CheckReport
from aero_viz.browser import find_chromium
from aero_viz.errors import UserError
from aero_viz.planners.registry import PLANNERS

_PACKAGES = ("aero-planner", "aero-viz", "warp-lang", "numpy", "viser", "rosbags", "mcap", "trimesh", "tyro")


@dataclass(frozen=True)
class PlugInState:
    """What an installed distribution brings, and whether it is used."""

    name: str
    kind: str
    """Such as "scene" or "cost term"."""
    distribution: str
    place: str
    state: str
    """"ok", or why it is left out."""

    def check(self) -> Check:
        """Return the state as a check; nothing that was brought is required."""
        finding = f"{self.distribution}, {self.place}" if self.state == "ok" else self.state
        advice = f"Update or remove {self.distribution}, which brings it."
        return Check(f"{self.kind} {self.name}", finding, ok=self.state == "ok", required=False, advice=advice)


@dataclass(frozen=True)
class DoctorReport(CheckReport):
    """The checks of this machine, and everything that other distributions bring."""

    plug_ins: tuple[PlugInState, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the checks, and the plug-ins as a list of dictionaries at "plug_ins"."""
        return {**super().to_dict(), "plug_ins": [vars(plug_in) for plug_in in self.plug_ins]}


def examine() -> DoctorReport:
    """Check this machine. This takes a few seconds, because it plans once on every device."""
    plug_ins = find_plug_ins()
    is_supported = sys.version_info >= (3, 11)
    checks = [
        Check("python", platform.python_version(), is_supported, advice="Use Python 3.11 or newer."),
        Check("system", f"{platform.platform()}, {os.cpu_count()} cores"),
        *map(_check_package, _PACKAGES),
        *_check_devices(),
        _check_package("playwright", needed_for="snapshots and browser tests"),
        _check_browser(),
        *map(_check_planner, PLANNERS.shipped),
        *(plug_in.check() for plug_in in plug_ins),
    ]
    return DoctorReport(
        tuple(checks), "Everything required is installed.", "Something required is missing; see FAIL above.", plug_ins
    )


def find_plug_ins() -> tuple[PlugInState, ...]:
    """Import everything that entry points bring, and return what became of it."""
    from aero_viz.cli.commands import COMMANDS
    from aero_viz.dashboard.layers import LAYERS
    from aero_viz.dashboard.panels.layout import PANELS
    from aero_viz.recordings.storage import FORMATS
    from aero_viz.scenes import SCENES
    from aero_viz.sensors import LIDARS

    found = [
        (plug_in, parts.kind, problem)
        for parts in (PLANNERS, SCENES, LIDARS, FORMATS, LAYERS, PANELS, COMMANDS)
        for plug_in, problem in parts.plug_ins()
    ]
    for kind in get_args(registry.Kind):
        found += [(plug_in, registry.label(kind), problem) for plug_in, problem in registry.checked(kind)]
    return tuple(PlugInState(p.name, kind, p.distribution, p.place, problem or "ok") for p, kind, problem in found)


def _check_package(name: str, *, needed_for: str = "") -> Check:
    """Check that a package is installed. It is required unless only an optional function needs it."""
    try:
        return Check(name, importlib.metadata.version(name))
    except importlib.metadata.PackageNotFoundError:
        prefix = f"Needed only for {needed_for}: " if needed_for else ""
        advice = f"{prefix}{sys.executable} -m pip install {name}"
        return Check(name, "not installed", ok=False, required=not needed_for, advice=advice)


def _check_devices() -> list[Check]:
    import warp as wp

    checks = [_check_device(str(device)) for device in wp.get_devices()]
    if not wp.is_cuda_available():
        advice = "Optional: an NVIDIA GPU with driver 580 or newer makes batches of flights fast."
        checks.append(Check("CUDA", "no GPU or driver", ok=False, required=False, advice=advice))
    return [*checks, Check("kernel cache", str(wp.config.kernel_cache_dir))]


def _check_device(device: str) -> Check:
    import numpy as np
    import warp as wp

    from aero_planner import Goal, Planner, PlannerConfig, VehicleState

    name = f"device {device}"
    try:
        planner = Planner(PlannerConfig(), device=device)
        state = VehicleState((0.0, 0.0, 2.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
        goal, points = Goal((10.0, 0.0, 2.0)), np.full((1000, 3), 5.0)
        planner.plan(state, goal, points)  # loads the kernels
        plan = planner.plan(state, goal, points)
        planner.close()
    except Exception as error:  # whatever a driver or compiler raises
        advice = "Delete Warp's kernel cache (python -c 'import warp; warp.clear_kernel_cache()') or update the driver."
        return Check(name, f"cannot plan: {error}", ok=False, required=device == "cpu", advice=advice)
    return Check(name, f"{wp.get_device(device).name}: plans in {plan.stage_ms['total']:.1f} ms")


def _check_planner(name: str) -> Check:
    """Check that a planner that ships can be imported."""
    try:
        planner = PLANNERS[name]
        return Check(f"planner {name}", f"{len(planner.parameters())} parameters, {planner.__module__}")
    except UserError as error:
        return Check(f"planner {name}", str(error), ok=False, advice="Reinstall aero-viz.")


def _check_browser() -> Check:
    try:
        return Check("chromium", find_chromium())
    except UserError as error:
        advice = f"Needed only for snapshots and browser tests. {error}"
        return Check("chromium", "not found", ok=False, required=False, advice=advice)
