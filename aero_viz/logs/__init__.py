"""Flight logs: MCAP files that hold every tick of a session as standard ROS 2 messages."""

from __future__ import annotations

from aero_viz.logs.flight_log import FlightLog, flight_recorder, record
from aero_viz.logs.foxglove_server import foxglove_recorder, serve_foxglove

__all__ = ["FlightLog", "flight_recorder", "foxglove_recorder", "record", "serve_foxglove"]
