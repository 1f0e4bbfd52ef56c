"""Settings of the node that flies: default, unit, bounds, label and help of each, and their configuration files."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from typing import ClassVar

from aero_planner.config import PlannerConfig
from aero_planner.config.file import ONBOARD, ConfigFile, format_sections
from aero_planner.config.parameter import ParameterSection, SectionedConfig, live, structural, switch, text

__all__ = [
    "BrakeSettings",
    "LidarSettings",
    "LimitSettings",
    "MavlinkSettings",
    "OnboardConfig",
    "RateSettings",
    "TelemetrySettings",
    "ThrustSettings",
    "check_together",
    "format_onboard",
    "load_any",
    "load_flight_config",
    "load_onboard",
]


_ADDRESS = r"[A-Za-z0-9_.:-]+"


@dataclass(frozen=True)
class LidarSettings(ParameterSection, section="lidar"):
    """The LiDAR: where its packets arrive, and how it is mounted."""

    host: str = text("0.0.0.0", _ADDRESS, "an address of this computer", "Address on which points arrive; all of them.")
    port: int = structural(56301, 0, 65535, "UDP port to which the sensor sends its points; 0 takes any free one.")
    sensor: str = text("any", _ADDRESS, "an address, or any", "Address of the sensor; others are not listened to.")
    keep_uncertain: bool = switch(True, "Keep points that the sensor thinks perhaps, not likely, to be rain or dust.")
    mount_x: float = live(0.0, "m", -5.0, 5.0, "Sensor in the body frame, forward of the centre.")
    mount_y: float = live(0.0, "m", -5.0, 5.0, "Sensor in the body frame, left of the centre.")
    mount_z: float = live(0.0, "m", -5.0, 5.0, "Sensor in the body frame, above the centre.")
    mount_roll: float = live(0.0, "deg", -180.0, 180.0, "Sensor turned about the body's x axis; 180 hangs upside down.")
    mount_pitch: float = live(0.0, "deg", -180.0, 180.0, "Sensor turned about the y axis; positive looks down.")
    mount_yaw: float = live(0.0, "deg", -180.0, 180.0, "Sensor turned about the z axis; positive looks left.")
    sweeps: int = structural(10, 1, 50, "Sweeps that make up the cloud.")
    sweep_period: float = live(0.1, "s", 0.01, 1.0, "Duration of a sweep: 10 sweeps per second.")
    points_max: int = structural(
        200_000, 100, 5_000_000, "Points of the cloud at most, the oldest go first; a Mid-360 measures 20 000 a sweep."
    )


@dataclass(frozen=True)
class MavlinkSettings(ParameterSection, section="mavlink"):
    """The autopilot."""

    url: str = text(
        "udpin:127.0.0.1:14540", r"[A-Za-z0-9_./:,-]+", "a connection such as udpin:0.0.0.0:14540 or /dev/ttyTHS1",
        "Where the autopilot is, as pymavlink writes it: udpin:ADDRESS:PORT, udpout:ADDRESS:PORT or a serial device.",
    )  # fmt: skip
    baud: int = structural(921_600, 1200, 12_500_000, "Bits per second of a serial device.")
    system: int = structural(1, 1, 255, "System id of the autopilot, and ours: this computer is part of the vehicle.")
    component: int = structural(191, 1, 255, "Component id of this computer; 191 is the first onboard computer.")
    state_rate: float = live(100.0, "Hz", 0.0, 500.0, "States that the autopilot is asked for; 0 asks for nothing.")


@dataclass(frozen=True)
class RateSettings(ParameterSection, section="rates"):
    """How often things happen."""

    control: float = live(50.0, "Hz", 10.0, 200.0, "Commands per second.")
    replan: float = live(20.0, "Hz", 1.0, 100.0, "Plans per second, as far as planning is fast enough.")
    compensate: bool = switch(
        True, "Plan from where the drone will be when the plan is ready, not from where it was when planning began."
    )


@dataclass(frozen=True)
class ThrustSettings(ParameterSection, section="thrust"):
    """From newton to the autopilot's thrust of 0 to 1."""

    hover_thrust: float = live(
        0.5, "", 0.05, 0.95, "Thrust of 0 to 1 at which the drone hovers: the autopilot's MPC_THR_HOVER, measured."
    )
    curve: float = live(
        0.0, "", 0.0, 1.0, "Share of the square in thrust over command: 0 where the autopilot makes it linear itself, "
        "its THR_MDL_FAC set to fit the motors; the motors' own only where that is 0.",
    )  # fmt: skip


@dataclass(frozen=True)
class LimitSettings(ParameterSection, section="limits"):
    """What may go on, and for how long."""

    state_age: float = live(0.2, "s", 0.02, 2.0, "Age of the vehicle's state above which the drone brakes.")
    cloud_age: float = live(0.5, "s", 0.05, 5.0, "Age of the newest point above which the drone brakes.")
    plan_age: float = live(0.3, "s", 0.05, 2.0, "Age of a plan above which it is not flown any more.")
    heartbeat_age: float = live(
        3.0, "s", 0.2, 10.0, "Time without heartbeat after which the link counts as lost; PX4 sends one per second."
    )
    deadline: float = live(
        0.1, "s", 0.02, 1.0, "Time for which the control loop may stand still; the watchdog then brakes in its place."
    )
    blind_time: float = live(
        1.5,
        "s",
        0.0,
        5.0,
        "Time for which the drone is braked and levelled by dead reckoning before it is handed back.",
    )
    brake_time: float = live(5.0, "s", 0.5, 30.0, "Time in which the drone must have come to rest.")
    hold_time: float = live(10.0, "s", 0.0, 600.0, "Time for which the drone waits at rest for a way to go on.")
    speed_stopped: float = live(0.3, "m/s", 0.05, 2.0, "Speed below which the drone counts as at rest.")
    arrival_radius: float = live(0.5, "m", 0.05, 10.0, "Distance from the goal at which it is reached.")
    fence_radius: float = live(100.0, "m", 1.0, 1e5, "Horizontal distance from the local origin not to be exceeded.")
    fence_height_min: float = live(
        0.3, "m", -1e4, 1e4, "Height above the local origin not to be undercut; a drone on the ground is below it."
    )
    fence_height_max: float = live(30.0, "m", -1e4, 1e4, "Height above the local origin not to be exceeded.")
    fence_x_min: float = live(-1e5, "m", -1e5, 1e5, "Box around the local origin: least x (north).")
    fence_x_max: float = live(1e5, "m", -1e5, 1e5, "Box around the local origin: largest x (north).")
    fence_y_min: float = live(-1e5, "m", -1e5, 1e5, "Box around the local origin: least y (west).")
    fence_y_max: float = live(1e5, "m", -1e5, 1e5, "Box around the local origin: largest y (west).")
    join_armed: bool = switch(
        False, "Take part in a flight that is under way when the node starts. Off, the drone must be seen disarmed "
        "first, so that a node that was restarted in the air stays silent.",
    )  # fmt: skip


@dataclass(frozen=True)
class BrakeSettings(ParameterSection, section="brake"):
    """How the drone is stopped and held where no plan is flown."""

    acceleration: float = live(6.0, "m/s^2", 0.5, 20.0, "Largest deceleration.")
    time_constant: float = live(0.4, "s", 0.1, 5.0, "Time in which the last of the speed falls to a third.")
    position_gain: float = live(1.5, "1/s^2", 0.0, 10.0, "Pull back to the place to hold.")
    attitude_gain: float = live(8.0, "1/s", 1.0, 30.0, "Body rate per angle of tilt to be corrected.")


@dataclass(frozen=True)
class TelemetrySettings(ParameterSection, section="telemetry"):
    """What the desk sees."""

    enabled: bool = switch(True, "Serve the live plan to `aero-viz connect`.")
    host: str = text(
        "127.0.0.1", _ADDRESS, "an address of this computer",
        "Address to listen on; 0.0.0.0 lets everyone in the network watch, and nobody steer.",
    )  # fmt: skip
    port: int = structural(14650, 0, 65535, "TCP port to listen on; 0 takes any free one.")
    rate: float = live(10.0, "Hz", 0.1, 50.0, "Frames per second at most.")
    points_max: int = structural(20_000, 0, 1_000_000, "Points per frame at most; of more, every n-th is sent.")
    clients_max: int = structural(4, 1, 64, "Viewers at a time.")


@dataclass(frozen=True)
class OnboardConfig(SectionedConfig):
    """All settings of the node.

    Raises:
        ValueError: a setting is outside its bounds or contradicts another one; names it, its value and the range.
    """

    noun: ClassVar[str] = "setting"

    lidar: LidarSettings = field(default_factory=LidarSettings)
    mavlink: MavlinkSettings = field(default_factory=MavlinkSettings)
    rates: RateSettings = field(default_factory=RateSettings)
    thrust: ThrustSettings = field(default_factory=ThrustSettings)
    limits: LimitSettings = field(default_factory=LimitSettings)
    brake: BrakeSettings = field(default_factory=BrakeSettings)
    telemetry: TelemetrySettings = field(default_factory=TelemetrySettings)

    def __post_init__(self) -> None:
        super().__post_init__()
        for stem in ("fence_height", "fence_x", "fence_y"):
            low, high = getattr(self.limits, f"{stem}_min"), getattr(self.limits, f"{stem}_max")
            if low >= high:
                raise ValueError(
                    f"limits.{stem}_min is {low}; it must be less than limits.{stem}_max, which is {high}."
                )
        if self.limits.plan_age * self.rates.replan < 2.0:
            raise ValueError(
                f"limits.plan_age is {self.limits.plan_age}; at {self.rates.replan:g} plans per second it must be at "
                f"least {2.0 / self.rates.replan:g} s, or every plan is too old before the next one is there."
            )
        if self.limits.deadline * self.rates.control < 2.0:
            raise ValueError(
                f"limits.deadline is {self.limits.deadline}; at {self.rates.control:g} commands per second it must be "
                f"at least {2.0 / self.rates.control:g} s."
            )


def check_together(planner: PlannerConfig, onboard: OnboardConfig) -> None:
    """Raise ValueError when the planner's configuration and the node's contradict each other."""
    if onboard.limits.plan_age >= planner.horizon:
        raise ValueError(
            f"limits.plan_age is {onboard.limits.plan_age}; it must be less than the planner's horizon, "
            f"sampling.steps x sampling.dt = {planner.horizon:g} s."
        )
    if planner.vehicle.thrust_max <= planner.vehicle.mass * planner.vehicle.gravity:
        raise ValueError(
            f"vehicle.thrust_max is {planner.vehicle.thrust_max} N; it must exceed the weight of "
            f"{planner.vehicle.mass * planner.vehicle.gravity:.2f} N, or the drone can't fly."
        )


def load_flight_config(path: str | os.PathLike[str]) -> tuple[PlannerConfig, OnboardConfig]:
    """Read the configuration of the planner and, from below `onboard:`, that of the node; the rest is the default.

    Raises:
        ValueError: as `aero_planner.config.file.load_config`.
    """
    file = ConfigFile.read(path)
    return file.planner_config(), file.change(OnboardConfig(), file.onboard_entries() or ())


def load_onboard(path: str | os.PathLike[str]) -> OnboardConfig:
    """Read the configuration of the node from a file without planner parameters.

    The sections may stand below `onboard:` or, without this line, at the top level.

    Raises:
        ValueError: as `load_flight_config`, or the file has planner parameters.
    """
    file = ConfigFile.read(path)
    sections = file.onboard_entries()
    if sections is None:
        return file.change(OnboardConfig(), file.entries)
    for entry in file.entries:
        if entry.key != ONBOARD:
            raise ValueError(
                f"{path}, line {entry.line}: {entry.key!r} is not one of the node's settings, which belong below "
                f"'{ONBOARD}:'; give a file with both as --config."
            )
    return file.change(OnboardConfig(), sections)


def load_any(path: str | os.PathLike[str]) -> tuple[PlannerConfig, OnboardConfig]:
    """Read a file with planner parameters, settings of the node, or both; raises ValueError as the functions above."""
    entries = ConfigFile.read(path).entries
    if entries and entries[0].key in OnboardConfig.sections():
        return PlannerConfig(), load_onboard(path)
    return load_flight_config(path)


def format_onboard(config: OnboardConfig) -> str:
    """Return the `onboard:` part of a configuration file: every setting with its help, range and unit."""
    return "\n".join([f"{ONBOARD}:", *format_sections(config, "  "), ""])
