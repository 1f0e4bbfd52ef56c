"""Versions and hardware, which results depend on besides their seeds."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from pathlib import Path
from typing import Any

_PACKAGES = ("aero-viz", "aero-planner", "warp-lang", "numpy")


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that results depend on."""
    return {"python": platform.python_version(), **{name: importlib.metadata.version(name) for name in _PACKAGES}}


def hardware(device: str) -> dict[str, Any]:
    """Return processor, memory and, on CUDA, the GPU of a Warp device."""
    import psutil
    import warp as wp

    facts: dict[str, Any] = {
        "system": platform.platform(),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "memory_gib": round(psutil.virtual_memory().total / 2**30, 1),
        "device": device,
    }
    warp_device = wp.get_device(device)
    if warp_device.is_cuda:
        facts["gpu"] = warp_device.name
        facts["gpu_memory_gib"] = round(warp_device.total_memory / 2**30, 1)
        facts["cuda_driver"] = ".".join(map(str, wp.get_cuda_driver_version() or ()))
    return facts


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
