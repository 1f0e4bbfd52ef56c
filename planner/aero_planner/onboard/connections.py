"""Builds the node's connections from its settings."""

from __future__ import annotations

from aero_planner.config import VehicleConfig
from aero_planner.onboard.livox import LivoxSource
from aero_planner.onboard.mavlink import MavlinkLink, MavlinkSender
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.thrust import ThrustModel

__all__ = ["make_sender", "open_lidar", "open_link", "thrust_model"]


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
            thrust_model(config, vehicle),
            baud=settings.baud,
            system=settings.system,
            component=settings.component,
            state_rate=settings.state_rate,
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
    system, component = config.mavlink.system, config.mavlink.component
    return MavlinkSender(None, system=system, component=component, thrust=thrust_model(config, vehicle))


def thrust_model(config: OnboardConfig, vehicle: VehicleConfig) -> ThrustModel:
    """Return the model with which thrust is converted to the autopilot's normalised thrust."""
    return ThrustModel(vehicle.mass, vehicle.gravity, config.thrust.hover_thrust, config.thrust.curve)


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
