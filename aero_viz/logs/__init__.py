"""Flight logs: MCAP files that hold every tick of a session as standard ROS 2 messages."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aero_planner.lazy_import import lazy_exports

if TYPE_CHECKING:
    from aero_viz.logs.flight_log import FlightLog, flight_recorder, record
    from aero_viz.logs.foxglove_server import foxglove_recorder, serve_foxglove

__all__ = ["FlightLog", "flight_recorder", "foxglove_recorder", "record", "serve_foxglove"]

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "flight_log": ("FlightLog", "flight_recorder", "record"),
        "foxglove_server": ("foxglove_recorder", "serve_foxglove"),
    },
)
