"""Missions that the node is given: by its settings, or by a sender who waits for an answer."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from numpy.typing import ArrayLike

from aero_planner.mission_file import read_mission
from aero_planner.missions import Mission
from aero_planner.onboard.settings import OnboardConfig


@dataclass(eq=False)
class MissionOffer:
    """A mission that has arrived over the link, to which the node answers."""

    mission: Mission | None
    """None clears the present mission."""
    answer: str | None = None
    """None until the node has decided, "" once it was taken, otherwise why it was refused."""


def first_goal(onboard: OnboardConfig, goal: ArrayLike | None) -> ArrayLike | Mission | None:
    """Return where to fly at the start: the goal of the command line, the mission of the settings, or None.

    Raises:
        ValueError: both are given, or the file is no mission; the text says what to do.
    """
    file = onboard.mission.file
    if file == "none":
        return goal
    if goal is not None:
        raise ValueError(f"--goal and mission.file ({file}) both say where to fly; give one.")
    return read_mission(Path(file).expanduser())
