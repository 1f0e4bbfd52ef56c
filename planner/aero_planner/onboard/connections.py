"""Builds the node's connections from its settings."""

from __future__ import annotations

from typing import Any

from aero_planner.config import VehicleConfig
from aero_planner.onboard.livox import LivoxSource
from aero_planner.onboard.mavlink import MavlinkLink
from aero_planner.onboard.mavlink_sender import MavlinkSender
from aero_planner.onboard.settings import OnboardConfig

__all__ = ["make_sender", "open_lidar", "open_link"]


def open_link(config: OnboardConfig, vehicle: VehicleConfig) -> MavlinkLink:
    """Connect to the autopilot.

    Raises:
        ImportError: pymavlink is not installed; names the extra to install.
        ValueError: The URL is not understood.
        OSError: The port is in use or the device does not exist; says what to do.
    """
    settings = config.mavlink
    try:
        return MavlinkLink(
            settings.url,
            baud=settings.baud,
            state_rate=settings.state_rate,
            **_sender_options(config, vehicle),
        )
    except OSError as error:
        raise OSError(
            f"can't open the connection to the autopilot, {settings.url} (mavlink.url): {error.strerror or error}; "
            "stop the program that uses it, or correct the URL."
        ) from error


def make_sender(config: OnboardConfig, vehicle: VehicleConfig) -> MavlinkSender:
    """Return a sender of the same commands as those of `open_link`, without a transport yet.

    Raises:
        ImportError: pymavlink is not installed; names the extra to install.
    """
    return MavlinkSender(None, **_sender_options(config, vehicle))


def _sender_options(config: OnboardConfig, vehicle: VehicleConfig) -> dict[str, Any]:
    """Return the MAVLink identity and the thrust model with which commands are sent."""
    return dict(
        system=config.mavlink.system,
        component=config.mavlink.component,
        mass=vehicle.mass,
        gravity=vehicle.gravity,
        hover_thrust=config.thrust.hover_thrust,
        curve=config.thrust.curve,
    )


def open_lidar(config: OnboardConfig) -> LivoxSource:
    """Listen to the LiDAR.

    Raises:
        OSError: The port is in use; says what to do.
    """
    settings = config.lidar
    sensor = None if settings.sensor == "any" else settings.sensor
    try:
        return LivoxSource(settings.port, host=settings.host, sensor=sensor, keep_uncertain=settings.keep_uncertain)
    except OSError as error:
        raise OSError(
            f"can't listen on the LiDAR's UDP port {settings.host}:{settings.port} (lidar.host, lidar.port): "
            f"{error.strerror or error}; stop the program that uses it, or correct the settings."
        ) from error
