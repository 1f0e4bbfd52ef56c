"""Flight logs: every tick of a session as standard ROS 2 messages in an MCAP file."""

from __future__ import annotations

from aero_viz.logs.flight_log import FlightLog, fly_and_log, record

__all__ = ["FlightLog", "fly_and_log", "record"]
