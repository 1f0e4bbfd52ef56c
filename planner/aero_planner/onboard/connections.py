"""Builds the node's connections from its settings."""

from __future__ import annotations

import contextlib
import ipaddress
import socket
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from aero_planner.config import VehicleConfig
from aero_planner.onboard.interfaces import PointSource
from aero_planner.onboard.livox import LivoxSource
from aero_planner.onboard.mavlink import MavlinkLink
from aero_planner.onboard.mavlink_sender import MavlinkSender
from aero_planner.onboard.mavlink_signing import load_key
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.signing_memory import SigningMemory
from aero_planner.onboard.thrust import ThrustModel

if TYPE_CHECKING:
    from aero_planner.onboard.ros import RosInputs


def is_loopback(host: str) -> bool:
    """Return True if only programs of this computer can reach an address of it."""
    try:
        return ipaddress.ip_address(socket.gethostbyname(host)).is_loopback
    except (OSError, ValueError):
        return False


@contextlib.contextmanager
def ros_inputs(config: OnboardConfig, *, clock: Callable[[], float] = time.monotonic) -> Iterator[RosInputs | None]:
    """Take part in ROS 2 while the context is open; None where the settings ask for nothing from there.

    Raises:
        ImportError, OSError: See `aero_planner.onboard.ros.RosInputs`.
    """
    if "ros" not in (config.lidar.source, config.state.source):
        yield None
        return
    from aero_planner.onboard.ros import RosInputs

    with contextlib.closing(RosInputs(config, clock=clock)) as inputs:
        yield inputs


def open_link(
    config: OnboardConfig,
    vehicle: VehicleConfig,
    ros: RosInputs | None = None,
    *,
    clock: Callable[[], float] = time.monotonic,
) -> MavlinkLink:
    """Connect to the autopilot; `clock` is the host time [s], `ros` the result of `ros_inputs`.

    Raises:
        ImportError: pymavlink is not installed; names the extra to install.
        ValueError: The URL is not understood, the signing key can't be read, or its time stamps can't be kept.
        OSError: The port is in use, the device does not exist, or a name has no address; says what to do.
    """
    settings, goal_senders, key = config.mavlink, _goal_senders(config), _signing_key(config)
    memory = None if key is None else SigningMemory(key)
    odometry = None if ros is None else ros.odometry
    try:
        link = MavlinkLink(
            settings.url,
            thrust_model(config, vehicle),
            baud=settings.baud,
            system=settings.system,
            component=settings.component,
            state_rate=settings.state_rate,
            round_trip_time=config.limits.round_trip_time,
            goal_senders=goal_senders,
            key=key,
            memory=memory,
            clock=clock,
            place=None if odometry is None else odometry.place,
        )
    except OSError as error:
        raise OSError(
            f"can't open the connection to the autopilot, {settings.url} (mavlink.url): {error.strerror or error}; "
            "stop the program that uses it, or correct the URL."
        ) from error
    if odometry is not None:
        odometry.dropped = link.dropped
    return link


def make_sender(config: OnboardConfig, vehicle: VehicleConfig) -> MavlinkSender:
    """Return a sender of the same commands as those of `open_link`, without a transport yet.

    Raises:
        ImportError: pymavlink is not installed; names the extra to install.
    """
    system, component = config.mavlink.system, config.mavlink.component
    key = _signing_key(config)
    return MavlinkSender(
        None, system=system, component=component, thrust=thrust_model(config, vehicle), key=key, link_id=1
    )


def _goal_senders(config: OnboardConfig) -> list[tuple[int, str | None]]:
    """Return system id and address of each sender of goals; None stands for the autopilot's connection."""
    senders: list[tuple[int, str | None]] = []
    for entry in config.mavlink.goal_senders.split(","):
        system, _, address = entry.partition("@")
        senders.append(
            (config.mavlink.system, None)
            if entry == "vehicle"
            else (int(system), None if address == "autopilot" else _resolve(address, "mavlink.goal_senders"))
        )
    return senders


def _resolve(name: str, setting: str) -> str:
    """Return the address of a name in a setting.

    Raises:
        OSError: There is none; names the setting.
    """
    try:
        return socket.gethostbyname(name)
    except OSError as error:
        raise OSError(
            f"can't find the address of {name} ({setting}): {error.strerror or error}; correct the name, or give an "
            "address such as 192.168.1.20."
        ) from error


def _signing_key(config: OnboardConfig) -> bytes | None:
    return load_key(config.mavlink.signing_key_file) if config.mavlink.is_signed else None


def thrust_model(config: OnboardConfig, vehicle: VehicleConfig) -> ThrustModel:
    """Return the model with which thrust is converted to the autopilot's normalised thrust."""
    return ThrustModel(vehicle.mass, vehicle.gravity, config.thrust.hover_thrust, config.thrust.curve)


def open_lidar(
    config: OnboardConfig, ros: RosInputs | None = None, *, clock: Callable[[], float] = time.monotonic
) -> PointSource:
    """Listen to the LiDAR; `clock` is the host time [s], `ros` the result of `ros_inputs`.

    Raises:
        OSError: The port is in use, or the sensor's name has no address; says what to do.
        ValueError: The sensor's address is missing although other computers can reach the port.
    """
    settings = config.lidar
    if ros is not None and ros.points is not None:
        return ros.points
    sensor = None if settings.sensor == "any" else _resolve(settings.sensor, "lidar.sensor")
    if sensor is None and not is_loopback(settings.host):
        raise ValueError(
            f"lidar.sensor is any, but every computer in the network can send points to {settings.host}:"
            f"{settings.port}; set lidar.sensor to the sensor's address, for a Mid-360 192.168.1.1xx with the last two "
            "digits of its serial number, or lidar.host to 127.0.0.1."
        )
    try:
        return LivoxSource(
            settings.port, host=settings.host, sensor=sensor, keep_uncertain=settings.keep_uncertain, clock=clock
        )
    except OSError as error:
        raise OSError(
            f"can't listen on the LiDAR's UDP port {settings.host}:{settings.port} (lidar.host, lidar.port): "
            f"{error.strerror or error}; stop the program that uses it, or correct the settings."
        ) from error
