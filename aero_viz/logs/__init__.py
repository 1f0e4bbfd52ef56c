"""Flight logs: MCAP files that hold every tick of a session as standard ROS 2 messages."""

from __future__ import annotations

from aero_viz.logs.flight_log import FlightLog, flight_recorder, record

__all__ = ["FlightLog", "flight_recorder", "record"]
