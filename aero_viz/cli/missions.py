"""Missions on the command line: waypoints, and YAML files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from numpy.typing import ArrayLike

from aero_planner.mission_file import read_mission
from aero_planner.missions import WAYPOINT_FORM, Mission, Waypoint
from aero_viz.errors import UserError
from aero_viz.scenes.world import World

WaypointTexts = Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar=WAYPOINT_FORM)]
_ROW_STEP = 0.1
"""Smallest time between two rows of a recorded path [s]."""


def chosen_mission(waypoints: Sequence[str], path: Path | None, *, goal: ArrayLike | None) -> Mission | None:
    """Return the mission of the flags --waypoint, --mission and --goal; None if only a goal or none is given.

    Raises:
        UserError: two of them are given, or one is malformed.
    """
    given = [
        flag for flag, value in (("--waypoint", waypoints or None), ("--mission", path), ("--goal", goal))
        if value is not None
    ]  # fmt: skip
    if len(given) > 1:
        raise UserError(f"{' and '.join(given)} both say where to fly; give one. The last waypoint is the goal.")
    if path is not None:
        return load_mission(path)
    try:
        return Mission(tuple(Waypoint.parse(text) for text in waypoints)) if waypoints else None
    except ValueError as error:
        raise UserError(f"--waypoint: {error}") from error


def fly_through(world: World, mission: Mission) -> World:
    """Return a world that was loaded with the end of a mission as its goal, with that mission.

    A map that lies far from the origin is moved there, and its goal with it: so are the waypoints.
    """
    return world.with_mission(mission.moved(world.goal - np.array(mission.goal)))


def load_mission(path: Path) -> Mission:
    """Return the mission in a YAML file, see `read_mission`; a path may be the name of a trajectory beside it.

    Raises:
        UserError: a file cannot be read, or is no mission; the text names the file and the waypoint.
    """
    try:
        return read_mission(path, _recorded_path)
    except ValueError as error:
        raise UserError(str(error)) from error


def _recorded_path(path: Path) -> list[list[float]]:
    """Return rows of time and position of a trajectory: CSV, or a recording with odometry."""
    from aero_viz.evaluation.score import read_trajectory

    trajectory = read_trajectory(path)
    table = np.column_stack([trajectory.times, trajectory.positions])
    bins = np.floor((table[:, 0] - table[0, 0]) / _ROW_STEP + 1e-6)
    kept = np.flatnonzero(np.diff(bins, prepend=-1.0))
    return table[np.union1d(kept, len(table) - 1)].tolist()
