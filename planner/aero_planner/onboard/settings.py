"""Settings of the node: default, unit, bounds, label and help of each."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from aero_planner.onboard.address_patterns import ADDRESS, ANY_ADDRESS, CONNECTION, GOAL_SENDER, KEY_FILE, TOPIC
from aero_planner.onboard.tuning_limits import TUNING_LIMITS
from aero_planner.parameters import (
    ContradictionError,
    ParameterSection,
    SectionedConfig,
    choice,
    live,
    structural,
    switch,
    text,
)
from aero_planner.sweeps import THINNING


@dataclass(frozen=True)
class LidarSettings(ParameterSection, section="lidar"):
    """LiDAR: where its points come from, mounting, and the cloud made of its sweeps."""

    source: str = choice(
        "livox", ("livox", "ros"), "Where points come from: livox, the sensor's own packets; ros, lidar.topic of its "
        "driver, which then owns the port.", live=False,
    )  # fmt: skip
    topic: str = text(
        "/livox/lidar", TOPIC, "the name of a topic, such as /livox/lidar",
        "Topic of ROS 2 with PointCloud2 or CustomMsg in the sensor's frame.",
    )  # fmt: skip
    host: str = text(
        "0.0.0.0", ADDRESS, "an address of this computer",
        "Local address on which the packets of the sensor arrive; 0.0.0.0 stands for all addresses.",
        label="Local address",
    )  # fmt: skip
    port: int = structural(
        56301, 0, 65535, "UDP port to which the sensor sends its points; 0 uses any free port.", label="UDP port"
    )
    sensor: str = text(
        "any", ADDRESS, "an address, or any", "Address of the sensor; packets from other addresses are ignored. Any "
        "is accepted only where lidar.host is a loopback address.", label="Sensor address",
    )  # fmt: skip
    keep_uncertain: bool = switch(
        True, "Keep points that the sensor rates as possibly, but not probably, rain or dust.",
        label="Keep uncertain points",
    )  # fmt: skip
    mount_x: float = live(0.0, "m", -5.0, 5.0, "Position of the sensor in the body frame, forward.", label="Mount x")
    mount_y: float = live(0.0, "m", -5.0, 5.0, "Position of the sensor in the body frame, left.", label="Mount y")
    mount_z: float = live(0.0, "m", -5.0, 5.0, "Position of the sensor in the body frame, up.", label="Mount z")
    mount_roll: float = live(
        0.0, "deg", -180.0, 180.0, "Rotation of the sensor about the body x axis; 180 for a sensor upside down."
    )
    mount_pitch: float = live(
        0.0, "deg", -180.0, 180.0, "Rotation of the sensor about the y axis; positive values look down."
    )
    mount_yaw: float = live(
        0.0, "deg", -180.0, 180.0, "Rotation of the sensor about the z axis; positive values look left."
    )
    sweeps: int = structural(
        10, 1, 50, "Number of newest sweeps of which all points are in the cloud.", label="Sweeps in the cloud"
    )
    older_sweeps: int = structural(
        20, 0, 100, "Number of older sweeps of which one point in five is in the cloud: what was seen stays while the "
        "drone flies past it.", label="Older sweeps",
    )  # fmt: skip
    sweep_period: float = live(0.1, "s", 0.01, 1.0, "Duration of a sweep; 0.1 for 10 sweeps per second.")
    points_max: int = structural(
        200_000, 100, 5_000_000, "Largest number of points of the newest sweeps; beyond it, the oldest are dropped. A "
        "Mid-360 measures 20 000 points per sweep.", label="Maximum number of points",
    )  # fmt: skip

    @property
    def older_points_max(self) -> int:
        """Largest number of points that the older sweeps have before they are thinned."""
        return self.points_max * self.older_sweeps // self.sweeps

    @property
    def cloud_points_max(self) -> int:
        """Largest number of points from which the node plans."""
        return self.points_max + self.older_points_max // THINNING


@dataclass(frozen=True)
class StateSettings(ParameterSection, section="state"):
    """Vehicle state: the autopilot's own, or an odometry in ROS 2."""

    source: str = choice(
        "mavlink", ("mavlink", "ros"), "Where position, velocity and attitude come from: mavlink, the autopilot; ros, "
        "state.topic, which the autopilot fuses, too.", live=False,
    )  # fmt: skip
    topic: str = text(
        "/Odometry", TOPIC, "the name of a topic, such as /Odometry", "Topic of ROS 2 with nav_msgs/Odometry. Its "
        "stamps are of the clock of lidar.topic or, with lidar.source: livox, of this computer's date.",
    )  # fmt: skip
    pose: str = choice(
        "sensor", ("sensor", "body"), "What the pose is of: sensor, the LiDAR as mounted, as FAST-LIO2's; body.",
        live=False,
    )  # fmt: skip
    velocity: str = choice(
        "positions", ("positions", "body", "world"), "Where the velocity comes from: positions, as for FAST-LIO2, "
        "whose twist is empty; the twist in the frame of the body, as in ROS, or in that of the world.", live=False,
    )  # fmt: skip
    yaw: float = live(
        0.0, "deg", -180.0, 180.0, "Direction of the odometry's x axis in the autopilot's local frame: 0 is north, -90 "
        "east, as where MAVROS gives the odometry to the autopilot.", label="Yaw of the odometry's frame",
    )  # fmt: skip
    agree_distance: float = live(
        2.0, "m", 0.1, 1e4, "Distance from the autopilot's own position beyond which the odometry is not used.",
        label="Largest disagreement of the position",
    )  # fmt: skip
    agree_angle: float = live(
        15.0, "deg", 1.0, 180.0, "Angle from the autopilot's own attitude beyond which the odometry is not used.",
        label="Largest disagreement of the attitude",
    )  # fmt: skip


@dataclass(frozen=True)
class MavlinkSettings(ParameterSection, section="mavlink"):
    """Connection to the autopilot."""

    url: str = text(
        "udpin:127.0.0.1:14540", CONNECTION,
        "a connection such as udpin:0.0.0.0:14540, udpout:192.168.1.20:14540 or /dev/ttyTHS1",
        "Connection in the notation of pymavlink: udpin:ADDRESS:PORT, udpout:ADDRESS:PORT, or a serial device. With "
        "udpin, the first autopilot that is heard is the only one from then on.", label="Connection",
    )  # fmt: skip
    baud: int = structural(921_600, 1200, 12_500_000, "Bits per second of a serial device.", label="Baud rate")
    system: int = structural(
        1, 1, 255, "System id of the autopilot, which this computer shares as a part of the vehicle.", label="System id"
    )
    component: int = structural(
        191, 1, 255, "Component id of this computer; 191 is the first onboard computer.", label="Component id"
    )
    goal_senders: str = text(
        "vehicle", rf"{GOAL_SENDER}(,{GOAL_SENDER})*",
        "vehicle, or a list such as vehicle,255@autopilot,255@192.168.1.20, with system ids from 1 to 255",
        "Who may send goals, separated by commas: vehicle, the autopilot's own system; SYSTEM@autopilot, another "
        "system, such as a ground station, whose messages the autopilot forwards; SYSTEM@ADDRESS, one that sends them "
        "here itself.", label="Senders of goals",
    )  # fmt: skip
    signing_key_file: str = text(
        "none", KEY_FILE, "a path, or none",
        "File with the key of MAVLink's signatures: 64 hexadecimal digits, or a passphrase. With it, every message is "
        "signed, and messages without a valid signature are ignored.", label="Signing key file",
    )  # fmt: skip
    state_rate: float = live(
        100.0, "Hz", 0.0, 500.0, "Rate at which the autopilot is asked to send its state; 0 sends no request."
    )

    @property
    def is_signed(self) -> bool:
        """True if messages are signed."""
        return self.signing_key_file != "none"


@dataclass(frozen=True)
class MissionSettings(ParameterSection, section="mission"):
    """The mission that the node flies until another one or a goal arrives."""

    file: str = text("none", KEY_FILE, "a path, or none", "YAML file with waypoints, as --mission of `aero-viz fly`.")


@dataclass(frozen=True)
class RateSettings(ParameterSection, section="rates"):
    """Rates of control and planning."""

    control: float = live(50.0, "Hz", 10.0, 200.0, "Commands per second.", label="Control rate")
    replan: float = live(
        20.0, "Hz", 1.0, 100.0, "Plans per second, if planning is fast enough.", label="Replanning rate"
    )
    compensate: bool = switch(
        True, "Plan from the state that the drone will have when the plan is ready, not from its state when planning "
        "starts.", label="Compensate for the planning time",
    )  # fmt: skip


@dataclass(frozen=True)
class ThrustSettings(ParameterSection, section="thrust"):
    """Conversion of the thrust from newton to the 0 to 1 of the autopilot."""

    hover_thrust: float = live(
        0.5, "", 0.05, 0.95, "Thrust from 0 to 1 at which the drone hovers: the autopilot's measured MPC_THR_HOVER."
    )
    curve: float = live(
        0.0, "", 0.0, 1.0, "Quadratic share of the thrust as a function of the command: 0 if the autopilot linearizes "
        "it, with THR_MDL_FAC set to fit the motors; the share of the motors only if THR_MDL_FAC is 0.",
        label="Thrust curve",
    )  # fmt: skip
    adapt: bool = switch(
        True, "Correct the hover thrust in flight, from the vertical acceleration that commands cause.",
        label="Correct the hover thrust",
    )  # fmt: skip


@dataclass(frozen=True)
class LimitSettings(ParameterSection, section="limits"):
    """Limits within which the drone flies on: ages of the data, times and the geofence."""

    state_age: float = live(
        0.2, "s", 0.02, 2.0, "Age of the vehicle state above which the drone brakes.", label="Maximum state age"
    )
    cloud_age: float = live(
        0.5, "s", 0.05, 5.0, "Age of the newest point above which the drone brakes.", label="Maximum cloud age"
    )
    plan_age: float = live(
        0.3, "s", 0.05, 2.0, "Age above which a plan is not flown any more.", label="Maximum plan age"
    )
    position_std: float = live(
        2.0, "m", 0.05, 100.0, "Standard deviation of the position, as the autopilot reports it, above which the drone "
        "brakes.", label="Maximum position uncertainty",
    )  # fmt: skip
    velocity_std: float = live(
        0.5, "m/s", 0.05, 20.0, "Standard deviation of the velocity, as the autopilot reports it, above which the "
        "drone brakes; from half of it on, the drone flies more slowly.", label="Maximum velocity uncertainty",
    )  # fmt: skip
    fix_age: float = live(
        0.7, "s", 0.2, 1e4, "Time without a fix of the autopilot's GNSS receiver after which the drone brakes, if it "
        "ever had one. The estimator reports the loss only seconds later. At 1e4 s it never brakes, as a drone whose "
        "estimator has another source needs.", label="Maximum age of the GNSS fix",
    )  # fmt: skip
    drift_angle: float = live(
        1.5, "deg", 0.1, 45.0, "Change of the attitude's error, as measured by the LiDAR within 0.2 s, above which the "
        "drone brakes.", label="Maximum drift of the attitude",
    )  # fmt: skip
    drift_speed: float = live(
        0.3, "m/s", 0.01, 20.0, "Error of the velocity, as measured by the LiDAR, above which the drone brakes.",
        label="Maximum drift of the position",
    )  # fmt: skip
    drift_time: float = live(
        1.0, "s", 0.6, 10.0, "Time of the drift measurements, at most ten per second, whose median counts.",
        label="Time of the drift measurements",
    )  # fmt: skip
    heartbeat_age: float = live(
        3.0, "s", 0.2, 10.0, "Time without a heartbeat after which the link counts as lost; PX4 sends one per second.",
        label="Heartbeat timeout",
    )  # fmt: skip
    round_trip: float = live(
        0.2, "s", 0.05, 5.0, "Time from a request to the autopilot to its answer above which the drone brakes: "
        "commands arrive too late to control it by body rates.", label="Maximum round trip of the link",
    )  # fmt: skip
    round_trip_time: float = live(
        1.0, "s", 0.5, 10.0, "Time of the round trips, ten per second, whose median counts.",
        label="Time of the round trips",
    )  # fmt: skip
    deadline: float = live(
        0.1, "s", 0.02, 1.0, "Time without a tick of the control loop after which the watchdog brakes in its place.",
        label="Control loop deadline",
    )  # fmt: skip
    blind_time: float = live(
        2.0, "s", 0.0, 5.0, "Time for which a drone without a state estimate is braked and levelled by dead reckoning "
        "before it is handed back.",
        label="Dead reckoning time",
    )  # fmt: skip
    brake_time: float = live(
        5.0, "s", 0.5, 30.0, "Time within which the drone must come to rest.", label="Braking time"
    )
    hold_time: float = live(10.0, "s", 0.0, 600.0, "Time for which the drone waits at rest until it can fly on.")
    speed_stopped: float = live(
        0.3, "m/s", 0.05, 2.0, "Speed below which the drone counts as at rest.", label="Speed at rest"
    )
    arrival_radius: float = live(0.5, "m", 0.05, 10.0, "Distance from the goal at which the goal is reached.")
    fence_radius: float = live(
        100.0, "m", 1.0, 1e5, "Largest horizontal distance from the local origin.", group="Geofence"
    )
    fence_height_min: float = live(
        1.0, "m", -1e4, 1e4, "Smallest height above the ground, or above the local origin where the ground was not "
        "found; the autopilot's own height may be wrong by a metre.",
        label="Minimum fence height", group="Geofence",
    )  # fmt: skip
    fence_height_max: float = live(
        30.0, "m", -1e4, 1e4, "Largest height above the ground, or above the local origin where the ground was not "
        "found.", label="Maximum fence height", group="Geofence",
    )  # fmt: skip
    fence_x_min: float = live(
        -1e5, "m", -1e5, 1e5, "Box around the local origin: smallest x (north).",
        label="Minimum fence x", group="Geofence",
    )  # fmt: skip
    fence_x_max: float = live(
        1e5, "m", -1e5, 1e5, "Box around the local origin: largest x (north).",
        label="Maximum fence x", group="Geofence",
    )  # fmt: skip
    fence_y_min: float = live(
        -1e5, "m", -1e5, 1e5, "Box around the local origin: smallest y (west).",
        label="Minimum fence y", group="Geofence",
    )  # fmt: skip
    fence_y_max: float = live(
        1e5, "m", -1e5, 1e5, "Box around the local origin: largest y (west).",
        label="Maximum fence y", group="Geofence",
    )  # fmt: skip
    join_armed: bool = switch(
        False, "Take part in a flight that is under way when the node starts. Off, the node sends nothing until it has "
        "seen the drone disarmed, so that a restart in the air stays silent.",
        label="Join a flight under way",
    )  # fmt: skip


@dataclass(frozen=True)
class BrakeSettings(ParameterSection, section="brake"):
    """Controller that stops and holds the drone while no plan is flown."""

    acceleration: float = live(6.0, "m/s^2", 0.5, 20.0, "Largest deceleration.", label="Maximum deceleration")
    time_constant: float = live(0.4, "s", 0.1, 5.0, "Time within which the last of the speed falls to a third.")
    position_gain: float = live(1.5, "1/s^2", 0.0, 10.0, "Acceleration per distance from the position to hold.")
    attitude_gain: float = live(
        6.5, "1/s", 1.0, 30.0, "Body rate per angle of tilt to be corrected; PX4's MC_ROLL_P and MC_PITCH_P."
    )


@dataclass(frozen=True)
class ResponseSettings(ParameterSection, section="response"):
    """Response of the drone to commands, for predictions and dead reckoning. The defaults are those of PX4."""

    rate_lag: float = live(
        0.07, "s", 0.0, 1.0, "Time constant of the body rates' first-order response; 0 for none.", label="Rate lag"
    )
    thrust_lag: float = live(
        0.045, "s", 0.0, 1.0, "Time constant of the thrust's first-order response; 0 for none.", label="Thrust lag"
    )
    drag: float = live(0.3, "1/s", 0.0, 10.0, "Linear drag in dv = .. - k v.", symbol="k")


@dataclass(frozen=True)
class TelemetrySettings(ParameterSection, section="telemetry"):
    """Live view of the flight for viewers on the ground."""

    enabled: bool = switch(True, "Serve the live plan to `aero-viz connect`.")
    host: str = text(
        "127.0.0.1", ANY_ADDRESS, "an address of this computer",
        "Local address to listen on; with 0.0.0.0, everyone in the network can watch.",
        label="Local address",
    )  # fmt: skip
    port: int = structural(14650, 0, 65535, "TCP port to listen on; 0 uses any free port.", label="TCP port")
    rate: float = live(10.0, "Hz", 0.1, 50.0, "Largest number of frames per second.", label="Frame rate")
    points_max: int = structural(
        20_000, 0, 1_000_000, "Largest number of points per frame; of a larger cloud, every n-th point is sent.",
        label="Maximum number of points",
    )  # fmt: skip
    clients_max: int = structural(4, 1, 64, "Largest number of viewers.", label="Maximum number of viewers")


@dataclass(frozen=True)
class TuningSettings(ParameterSection, section="tuning"):
    """Changes of the planner's parameters from the ground, while the node runs."""

    limits: str = text(
        "none", TUNING_LIMITS, "none, or a list such as vehicle.speed_limit 1..5, costs.q_track 5..30",
        "What `aero-viz connect` and ROS may change, separated by commas: live parameters of the planner, a number "
        "with its bounds, anything else without.", label="Parameters that may be changed",
    )  # fmt: skip
    key_file: str = text(
        "none", KEY_FILE, "a path, or none",
        "File with the key of those who may change them: 64 hexadecimal digits, or a passphrase.", label="Key file",
    )  # fmt: skip


@dataclass(frozen=True)
class OnboardConfig(SectionedConfig):
    """All settings of the node.

    Raises:
        ValueError: a setting is out of bounds or contradicts another one; names setting, value and range.
    """

    noun: ClassVar[str] = "setting"
    listing: ClassVar[str] = "aero-planner config show"

    lidar: LidarSettings = field(default_factory=LidarSettings)
    state: StateSettings = field(default_factory=StateSettings)
    mavlink: MavlinkSettings = field(default_factory=MavlinkSettings)
    mission: MissionSettings = field(default_factory=MissionSettings)
    rates: RateSettings = field(default_factory=RateSettings)
    thrust: ThrustSettings = field(default_factory=ThrustSettings)
    limits: LimitSettings = field(default_factory=LimitSettings)
    brake: BrakeSettings = field(default_factory=BrakeSettings)
    response: ResponseSettings = field(default_factory=ResponseSettings)
    telemetry: TelemetrySettings = field(default_factory=TelemetrySettings)
    tuning: TuningSettings = field(default_factory=TuningSettings)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.limits.plan_age * self.rates.replan < 2.0:
            raise ContradictionError(
                f"limits.plan_age is {self.limits.plan_age}; with a rates.replan of {self.rates.replan:g} Hz it must "
                f"be at least {2.0 / self.rates.replan:g} s, or every plan is too old before the next one is ready.",
                "limits.plan_age", "rates.replan",
            )  # fmt: skip
        if self.limits.deadline * self.rates.control < 2.0:
            raise ContradictionError(
                f"limits.deadline is {self.limits.deadline}; with a rates.control of {self.rates.control:g} Hz it must "
                f"be at least {2.0 / self.rates.control:g} s.",
                "limits.deadline", "rates.control",
            )  # fmt: skip
