"""Export of a bundle for the node: its settings are checked and stored with the planner's configuration."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from aero_planner.config import PlannerConfig
from aero_planner.config.file import format_config, read_text
from aero_planner.deploy.export import export
from aero_planner.onboard.flight_config import format_onboard, load_checked


def export_bundle(
    out: str | os.PathLike[str],
    *,
    config: str | os.PathLike[str] = "default",
    architectures: Iterable[int] = (),
    cpu: bool = False,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Write a bundle for `aero-planner run --bundle` and for the C++ host; return its manifest.

    Args:
        out, architectures, cpu, overwrite: as for `aero_planner.deploy.export.export`.
        config: preset or configuration file, which is copied into the bundle unchanged.

    Raises:
        ValueError: the configuration is wrong, or as for `aero_planner.deploy.export.export`.
        OSError: the bundle can't be written.
    """
    planner, onboard = load_checked(config)
    is_file = str(config) not in PlannerConfig.presets() and Path(config).exists()
    text = read_text(config) if is_file else f"{format_config(planner)}\n{format_onboard(onboard)}"
    return export(
        out,
        config=text,
        max_points=onboard.lidar.cloud_points_max,
        architectures=architectures,
        cpu=cpu,
        overwrite=overwrite,
    )
