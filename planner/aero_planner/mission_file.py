"""YAML files with missions: a list `waypoints:`, see `aero_planner.missions.Waypoint`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from aero_planner.missions import Mission
from aero_planner.plain_yaml import load_yaml
from aero_planner.user_file import read_user_text

_BYTES_MAX = 64 << 20

PathReader = Callable[[Path], Sequence[Sequence[float]]]
"""Returns rows of time [s] and x, y, z [m] of a file."""


def read_mission(path: Path, read_path: PathReader | None = None) -> Mission:
    """Return the mission in a file.

    Args:
        path: the file.
        read_path: reads a recorded path that a waypoint names, beside the file; None accepts only rows.

    Raises:
        ValueError: the file cannot be read, or is no mission; the text names the file and the waypoint.
    """
    try:
        content = load_yaml(read_user_text(path, limit=_BYTES_MAX))
    except OSError as error:
        raise ValueError(f"Cannot read the mission {path}: {error.strerror or error}.") from error
    except ValueError as error:
        raise ValueError(f"{path} is {error}.") from error
    rows = content.get("waypoints") if isinstance(content, dict) else None
    if read_path is not None and isinstance(rows, list):
        for row in rows:
            if isinstance(row, dict) and isinstance(row.get("path"), str):
                row["path"] = read_path(path.parent / row["path"])
    try:
        return Mission.from_dict(content)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
