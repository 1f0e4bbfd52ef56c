"""A mission as a table on the page, and as a file."""

from __future__ import annotations

from pathlib import PurePath

import viser
import yaml
from numpy.typing import ArrayLike

from aero_planner.mission_progress import MissionProgress
from aero_planner.missions import Mission, point
from aero_planner.plain_yaml import load_yaml
from aero_viz.dashboard.layers.mission import shown_waypoints
from aero_viz.dashboard.panels import markup
from aero_viz.errors import UserError

_STATES = {"passed": "passed", "stopped": "stopped", "given_up": "given up"}


def describe(progress: MissionProgress, start: ArrayLike, speed_limit: float) -> str:
    """Return length, time and waypoints of a mission as HTML, with the reasons of those that were given up.

    Args:
        progress: the mission and its state.
        start: start of the flight [m], shape [3], world frame.
        speed_limit: that of the planner [m/s].
    """
    mission, ends = progress.mission, {event.waypoint: event for event in progress.events}
    rows, tooltips = [], []
    for i in shown_waypoints(progress):
        waypoint, end = mission.waypoints[i], ends.get(i)
        state = _STATES[end.kind] if end is not None else "next" if i == progress.index else "ahead"
        rows.append((f"{i + 1}", point(waypoint.position), state))
        asked = ["stop" if waypoint.stop else f"pass within {waypoint.radius:g} m"]
        asked += [] if waypoint.speed is None else [f"at up to {waypoint.speed:g} m/s"]
        tooltips.append(", ".join(asked) if end is None else end.text)
    given_up = [markup.text(event.text) for event in progress.events if event.kind == "given_up"]
    figures = (
        ("length", f"{mission.length(start):.1f}", "m"),
        ("time", f"{mission.duration(start, speed_limit):.0f}", "s or more"),
        ("passed", f"{progress.passed}", f"of {len(mission)}"),
    )
    table = markup.columns(("waypoint", "at [m]", "state"), rows, tooltips)
    return markup.block(markup.metrics(figures), table, *given_up[-len(rows) :])


def format_mission(mission: Mission) -> str:
    """Return a mission as YAML, in the form of `--mission`."""
    return yaml.safe_dump(mission.to_dict(), sort_keys=False, default_flow_style=None)


def parse_mission(file: viser.UploadedFile) -> Mission:
    """Return the mission in a file that a browser sent.

    Raises:
        UserError: the file is malformed; names the file as the user knows it, and the waypoint.
    """
    name = PurePath(file.name).name or "mission.yaml"
    try:
        text = file.content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise UserError(f"{name} is no text in UTF-8; choose a YAML file.") from None
    try:
        content = load_yaml(text)
    except ValueError as error:
        raise UserError(f"{name} is {error}.") from error
    try:
        return Mission.from_dict(content)
    except ValueError as error:
        raise UserError(f"{name}: {error}") from error
