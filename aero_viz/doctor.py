"""Check of this machine: versions, devices, browser, and what is missing with how to get it."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import platform
import sys
from dataclasses import asdict, dataclass
from typing import Any

from aero_viz.browser import find_chromium
from aero_viz.errors import UserError

__all__ = ["Check", "Report", "examine"]

_PACKAGES = ("aero-planner", "aero-viz", "warp-lang", "numpy", "viser", "rosbags", "mcap", "trimesh", "tyro")


@dataclass(frozen=True)
class Check:
    """One thing looked at."""

    name: str
    found: str
    ok: bool = True
    required: bool = True
    advice: str = ""
    """What to do when it is not ok."""


@dataclass(frozen=True)
class Report:
    """All checks."""

    checks: tuple[Check, ...]

    @property
    def healthy(self) -> bool:
        """Whether everything required is there."""
        return all(check.ok or not check.required for check in self.checks)

    def to_json(self) -> dict[str, Any]:
        """Return {"healthy": bool, "checks": [..]}."""
        return {"healthy": self.healthy, "checks": [asdict(check) for check in self.checks]}

    def format_table(self) -> str:
        """Return one line per check, with advice below what is missing."""
        width = max(len(check.name) for check in self.checks)
        lines = []
        for check in self.checks:
            mark = "ok     " if check.ok else "MISSING" if check.required else "absent "
            lines.append(f"{mark} {check.name:{width}}  {check.found}")
            if not check.ok:
                lines.append(f"{'':8}{'':{width}}  -> {check.advice}")
        lines.append("Everything required is there." if self.healthy else "Something required is missing; see above.")
        return "\n".join(lines)


def examine() -> Report:
    """Look at this machine; takes a few seconds, since it plans once on every device."""
    new_enough = sys.version_info >= (3, 11)
    python = Check("python", platform.python_version(), new_enough, True, "Use Python 3.11 or newer.")
    system = Check("system", f"{platform.platform()}, {os.cpu_count()} cores")
    return Report((python, system, *map(_package, _PACKAGES), *_devices(), _map_reader(), _playwright(), _browser()))


def _package(name: str) -> Check:
    try:
        return Check(name, importlib.metadata.version(name))
    except importlib.metadata.PackageNotFoundError:
        return Check(name, "not installed", False, True, f"pip install {name}")


def _devices() -> list[Check]:
    import numpy as np
    import warp as wp

    from aero_planner import Goal, Planner, PlannerConfig, VehicleState

    checks = []
    for device in map(str, wp.get_devices()):
        try:
            planner = Planner(PlannerConfig(), device=device)
            state = VehicleState((0.0, 0.0, 2.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
            for _ in range(2):  # the first plan also loads the kernels
                plan = planner.plan(state, Goal((10.0, 0.0, 2.0)), np.full((1000, 3), 5.0))
            planner.close()
            checks.append(
                Check(f"device {device}", f"{wp.get_device(device).name}: plans in {plan.stage_ms['total']:.1f} ms")
            )
        except Exception as error:
            advice = (
                "Delete Warp's kernel cache (python -c 'import warp; warp.clear_kernel_cache()') or update the driver."
            )
            checks.append(Check(f"device {device}", f"cannot plan: {error}", False, device == "cpu", advice))
    if not wp.is_cuda_available():
        advice = "Optional: an NVIDIA GPU with a driver of at least version 580 makes batches of flights fast."
        checks.append(Check("CUDA", "no GPU or driver", False, False, advice))
    checks.append(Check("kernel cache", str(wp.config.kernel_cache_dir)))
    return checks


def _map_reader() -> Check:
    try:
        importlib.import_module("open3d")
    except Exception as error:  # a missing system library raises OSError
        libraries = "libgl1 libgomp1 libusb-1.0-0 libx11-6"
        advice = (
            "Needed only for maps in text formats (XYZ, PTS): pip install 'aero-viz[maps]'; "
            f"on Debian and Ubuntu also sudo apt-get install {libraries}."
        )
        return Check("open3d loads", str(error).splitlines()[0], False, False, advice)
    return Check("open3d loads", "yes")


def _playwright() -> Check:
    try:
        return Check("playwright", importlib.metadata.version("playwright"))
    except importlib.metadata.PackageNotFoundError:
        advice = f"Needed only for snapshots and browser tests: {sys.executable} -m pip install playwright."
        return Check("playwright", "not installed", False, False, advice)


def _browser() -> Check:
    try:
        return Check("chromium", find_chromium())
    except UserError as error:
        return Check("chromium", "not found", False, False, f"Needed only for snapshots and browser tests. {error}")
