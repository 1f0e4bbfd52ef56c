"""The session: source -> planner -> frame at a fixed tick, with sinks, and commands from any thread. Headless."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aero_planner.lazy_import import lazy_exports

if TYPE_CHECKING:
    from aero_viz.session.base import BaseSession, SessionControls
    from aero_viz.session.frame import Frame, Notice
    from aero_viz.session.session import Session
    from aero_viz.session.source import Observation, Source, SourceInfo

__all__ = ["BaseSession", "Frame", "Notice", "Observation", "Session", "SessionControls", "Source", "SourceInfo"]

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "base": ("BaseSession", "SessionControls"),
        "frame": ("Frame", "Notice"),
        "session": ("Session",),
        "source": ("Observation", "Source", "SourceInfo"),
    },
)
