"""The node's connections, made from its settings."""

from __future__ import annotations

from typing import Any

from aero_planner.config import VehicleConfig
from aero_planner.onboard.livox import LivoxSource
from aero_planner.onboard.mavlink import MavlinkLink, MavlinkSender
from aero_planner.onboard.settings import OnboardConfig

__all__ = ["make_sender", "open_lidar", "open_link"]


def open_link(config: OnboardConfig, vehicle: VehicleConfig) -> MavlinkLink:
    """Connect to the autopilot.

    Raises:
        ImportError: pymavlink is missing; names the extra.
        ValueError: the URL is not understood.
        OSError: the port is taken or the device is not there; says what to do.
    """
    settings = config.mavlink
    try:
        return MavlinkLink(
            settings.url, baud=settings.baud, state_rate=settings.state_rate, **_identity(config, vehicle)
        )
    except OSError as error:
        raise OSError(
            f"the autopilot's connection {settings.url} (mavlink.url) can't be opened: {error.strerror or error}; "
            "stop what else uses it, or correct it."
        ) from error


def make_sender(config: OnboardConfig, vehicle: VehicleConfig) -> MavlinkSender:
    """Return what commands as `open_link` does, and has no port yet.

    Raises:
        ImportError: pymavlink is missing; names the extra.
    """
    return MavlinkSender(None, **_identity(config, vehicle))


def _identity(config: OnboardConfig, vehicle: VehicleConfig) -> dict[str, Any]:
    """Return as whom, and for which vehicle, commands are sent."""
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
        OSError: the port is taken; says what to do.
    """
    settings = config.lidar
    sensor = None if settings.sensor == "any" else settings.sensor
    try:
        return LivoxSource(settings.port, host=settings.host, sensor=sensor, keep_uncertain=settings.keep_uncertain)
    except OSError as error:
        raise OSError(
            f"the LiDAR's UDP port {settings.host}:{settings.port} (lidar.host, lidar.port) can't be listened on: "
            f"{error.strerror or error}; stop what else uses it, or correct it."
        ) from error
