"""Every parameter of the planner: default, unit, bounds, label, help, and whether it is basic, live or structural.

A *live* parameter is held in device memory and can change between two plans at no cost. A *structural* parameter sizes
buffers or selects kernels; changing it rebuilds the planner. Sliders, command line flags, YAML files and the
documentation are generated from the fields below. Symbols are those of the paper.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

from aero_planner.config.parameter import (
    ParameterSection,
    SectionedConfig,
    Value,
    choice,
    did_you_mean,
    live,
    structural,
    switch,
)
from aero_planner.config.presets import PRESETS


@dataclass(frozen=True)
class VehicleConfig(ParameterSection, section="vehicle"):
    """Model of the quadrotor."""

    mass: float = live(1.0, "kg", 0.05, 50.0, "Mass of the vehicle.", scale="log", symbol="m")
    gravity: float = live(9.81, "m/s^2", 0.0, 30.0, "Gravitational acceleration.", symbol="g")
    thrust_min: float = live(0.3, "N", 0.0, 500.0, "Smallest total thrust.", label="Minimum thrust", symbol="F_min")
    thrust_max: float = live(16.35, "N", 0.1, 1000.0, "Largest total thrust.", label="Maximum thrust", symbol="F_max")
    rate_xy_max: float = live(
        3.0, "rad/s", 0.1, 20.0, "Largest roll and pitch rate.", label="Maximum roll and pitch rate", symbol="omega_xy"
    )
    rate_z_max: float = live(2.0, "rad/s", 0.1, 20.0, "Largest yaw rate.", label="Maximum yaw rate", symbol="omega_z")
    thrust_lag: float = live(
        0.0, "s", 0.0, 1.0, "Time constant with which the thrust follows its commands; 0 as in the paper: at once.",
        label="Thrust lag", symbol="tau_F",
    )  # fmt: skip
    rate_xy_lag: float = live(
        0.0, "s", 0.0, 1.0, "Time constant with which roll and pitch rates follow their commands; 0 as in the paper. "
        "0.07 s for PX4.",
        label="Roll and pitch rate lag", symbol="tau_xy",
    )  # fmt: skip
    rate_z_lag: float = live(
        0.0, "s", 0.0, 1.0, "Time constant with which the yaw rate follows its commands; 0 as in the paper.",
        label="Yaw rate lag", symbol="tau_z",
    )  # fmt: skip
    delay: float = live(
        0.0, "s", 0.0, 0.5, "Time from a command to its effect: the latency, and the lag of the body rates where "
        "rate_xy_lag does not model it. Plans start from the state that is predicted for it.",
        label="Delay of commands",
    )  # fmt: skip
    speed_limit: float = live(
        7.0, "m/s", 0.2, 50.0,
        "Speed to stay below. It limits the look-ahead distance to 0.6 T v, the length at which a guide asks for no "
        "more speed, and costs.q_speed penalizes the excess.", basic=True,
    )  # fmt: skip


@dataclass(frozen=True)
class PartitionConfig(ParameterSection, section="partition"):
    """Spherical partition of the point cloud."""

    range_max: float = live(
        10.0,
        "m",
        1.0,
        100.0,
        "Points farther away than this are ignored.",
        label="Maximum range",
        symbol="r_max",
        basic=True,
    )
    range_time: float = live(
        1.0, "s", 0.0, 5.0, "A fast drone sees farther: the maximum range is at least this times the speed limit; 0 as "
        "in the paper.",
        label="Range per speed limit",
    )  # fmt: skip
    range_min: float = live(
        0.1, "m", 0.0, 5.0, "Points closer than this are ignored as returns from the drone itself; 0 as in the paper.",
        label="Minimum range",
    )  # fmt: skip
    cloud_age_max: float = live(
        0.5, "s", 0.05, 10.0, "Age of the cloud above which the drone brakes, if the caller states the age.",
        label="Maximum cloud age",
    )  # fmt: skip
    view_min: float = live(
        -7.0, "deg", -90.0, 90.0, "Lowest elevation that the sensor sees, body frame. What lies below is unknown.",
        label="Lower edge of the view",
    )  # fmt: skip
    view_max: float = live(
        52.0, "deg", -90.0, 90.0, "Highest elevation that the sensor sees, body frame.", label="Upper edge of the view"
    )
    continue_below: float = live(
        20.0, "m", 0.0, 20.0, "Depth to which the surface at the lower edge of the field of view is continued into "
        "empty cells that the sensor does not see; 0 as in the paper.",
        label="Continuation below",
    )  # fmt: skip
    continue_above: float = live(
        20.0, "m", 0.0, 20.0, "Height by which the surface at the upper edge of the field of view is continued into "
        "empty cells that the sensor does not see; 0 as in the paper.",
        label="Continuation above",
    )  # fmt: skip
    continue_before: float = live(
        1.0, "m", 0.0, 1e3, "Surfaces also continue in front of points that are farther by more than this: a point "
        "that was seen from elsewhere does not prove that the way to it is free.",
        label="Continuation before points",
    )  # fmt: skip
    view_age: float = live(
        0.1, "s", 0.0, 1.0, "Time since the sensor has seen all of its field of view. The drone moves meanwhile, so "
        "that surfaces near the edges of the field of view are continued as well; 0 as in the paper.",
        label="Age of the view",
    )  # fmt: skip
    predict: bool = switch(
        True, "Estimate the velocities of obstacles from successive sweeps, and keep clear of where they will be. Off "
        "as in the paper.",
        label="Predict motion",
    )  # fmt: skip
    predict_memory: bool = switch(
        True, "Follow moving obstacles for a second behind others, unless that space is seen to be free.",
        label="Remember motion",
    )  # fmt: skip
    predict_wake_speed: float = live(
        2.5, "m/s", 0.0, 50.0, "Speed limit below which points of older sweeps are left out where an obstacle has "
        "moved on since: they are a wall to a slow drone, and keep a fast one away from what may turn back. 0: never.",
        label="Speed limit for forgetting wakes",
    )  # fmt: skip
    predict_range: float = live(
        10.0, "m", 1.0, 100.0, "Obstacles farther away than this are taken for standing ones.",
        label="Range of predicted motion",
    )  # fmt: skip
    predict_speed: float = live(
        0.4, "m/s", 0.05, 10.0, "Obstacles slower than this are taken for standing ones.",
        label="Least speed of predicted motion",
    )  # fmt: skip
    predict_width: float = live(
        1.6, "m", 0.1, 10.0, "Obstacles wider than this are taken for standing ones.",
        label="Width of moving obstacles",
    )  # fmt: skip
    predict_growth: float = live(
        0.1, "m/s", 0.0, 10.0, "Rate at which the predicted radius of a moving obstacle grows.",
        label="Growth of moving obstacles",
    )  # fmt: skip
    fine_cells: int = structural(
        6, 2, 18, "Fine cells along each side of a coarse cell; 6 divide 18 deg into cells of 3 deg.",
        label="Fine cells per coarse cell", symbol="n",
    )  # fmt: skip
    coarse_columns: int = structural(20, 8, 40, "Coarse cells around the horizon; 20 are 18 deg wide each.")
    coarse_rows: int = structural(10, 4, 20, "Coarse cells from straight down to straight up; 10 are 18 deg high each.")


@dataclass(frozen=True)
class AnchorConfig(ParameterSection, section="anchors"):
    """Anchors: the end points of the guides."""

    columns: int = structural(5, 1, 15, "Anchor directions side by side.", label="Anchor columns", symbol="M_h")
    rows: int = structural(3, 1, 9, "Anchor directions one above the other.", label="Anchor rows", symbol="M_v")
    spacing: float = live(
        18.0, "deg", 1.0, 45.0, "Angle between neighbouring anchor directions.", label="Anchor spacing", basic=True
    )
    lookahead: float = live(
        5.0, "m", 0.2, 30.0, "Distance of the anchors from the drone; at most the distance of the goal, and at most "
        "0.6 times the way that the speed limit covers within the horizon.",
        label="Look-ahead distance", symbol="l", basic=True,
    )  # fmt: skip
    lookahead_time: float = live(
        0.65, "s", 0.0, 5.0, "A fast drone looks farther ahead: the look-ahead distance is at least this times the "
        "speed limit; 0 as in the paper.",
        label="Look-ahead per speed limit",
    )  # fmt: skip
    lookahead_rest: float = live(
        2.5, "m", 0.1, 30.0,
        "Look-ahead distance at rest. It grows by 0.6 T v with the speed v, up to the look-ahead distance: from rest, "
        "a guide of full length asks for an acceleration that saturates the thrust. A value of at least the look-ahead "
        "distance disables this, as in the paper.",
        label="Look-ahead distance at rest",
    )  # fmt: skip
    slow_spread: float = live(
        3.0, "", 1.0, 5.0, "Factor on the spacing at speeds below slow_speed, to find a way around an obstacle; 1 as "
        "in the paper.",
        label="Spread factor at low speed",
    )  # fmt: skip
    slow_speed: float = live(
        3.0, "m/s", 0.0, 20.0, "Speed below which slow_spread applies.", label="Low-speed threshold"
    )
    slow_rise: float = live(
        1.5, "", 1.0, 5.0, "The same factor on the spacing of the rows, upward and downward.",
        label="Rise factor at low speed",
    )  # fmt: skip
    slow_cycle: int = live(
        3, "", 1, 10, "Number of spreads at low speed: successive plans go from a part of slow_spread to all of it.",
        label="Spreads at low speed",
    )  # fmt: skip
    refine: bool = switch(True, "Move each anchor to the safe direction of its coarse cell.", label="Refine anchors")
    arrival_speed: float = live(
        0.0, "m/s", 0.0, 20.0, "Speed at the end of each guide, in the direction of its anchor.",
        label="Guide end speed", symbol="v_1",
    )  # fmt: skip


@dataclass(frozen=True)
class CandidateConfig(ParameterSection, section="candidates"):
    """Candidates in addition to the anchors, and the selection among all."""

    previous: bool = switch(
        True, "Add the previous best plan as a candidate, shifted in time and without the tracking cost, so that the "
        "drone stays on a path once found.",
        live=False, label="Previous plan",
    )  # fmt: skip
    brake: bool = switch(
        True, "Add a braking candidate, for when every other candidate crosses an obstacle.",
        live=False, label="Braking candidate",
    )  # fmt: skip
    safe_clearance: float = live(
        0.30,
        "m",
        0.0,
        5.0,
        "Clearance below which a candidate is unsafe: the radius of the drone plus a margin.",
        basic=True,
    )
    speed_margin: float = live(
        0.01, "s", 0.0, 0.5, "Addition to the clearances of candidates and stops per speed: a fast drone follows its "
        "plan less closely. 0 as in the paper.",
        label="Margin per speed",
    )  # fmt: skip
    between_steps: bool = switch(
        True, "Also check the clearance halfway between two time steps, which are 0.35 m apart at 7 m/s.",
        label="Check between time steps",
    )  # fmt: skip
    prefer_safe: bool = switch(
        True, "Select the cheapest safe candidate, and brake if no candidate is safe. Off as in the paper: the "
        "candidate with the lowest S2 is selected, and the drone brakes if it is unsafe.",
        label="Prefer safe candidates", basic=True,
    )  # fmt: skip
    prove_stop: str = choice(
        "instead", ("off", "required", "instead"),
        "Fly a candidate only while a clear stop remains: a braking manoeuvre that leaves it now or later. Otherwise "
        "the drone flies the stop that was proven last. Instead: such a candidate need not be clear beyond that.",
        label="Proven stop",
    )  # fmt: skip
    stop_clearance: float = live(
        0.3, "m", 0.0, 5.0, "Clearance of a proven stop, at most safe_clearance.", label="Clearance of a stop"
    )
    stop_seen: bool = switch(
        True, "A proven stop lies in space that is seen from the drone: not behind the nearest point of a fine cell.",
        label="Stop in seen space",
    )  # fmt: skip
    stop_speed: float = live(
        1.0, "m/s", 0.0, 50.0, "Speed below which a braking manoeuvre counts as a stop at its end.",
        label="Speed after a stop",
    )  # fmt: skip
    brake_reach: float = live(
        0.35, "", 0.1, 1.0, "Length of the braking guide as a fraction of v T; smaller values brake harder.",
        label="Braking distance factor",
    )  # fmt: skip
    brake_fan: float = live(
        20.0, "deg", 0.0, 45.0, "Angle between the five braking candidates, of which the one with the largest "
        "clearance is flown: there may be an obstacle straight ahead. 0 brakes straight ahead only.",
        label="Braking fan angle",
    )  # fmt: skip


@dataclass(frozen=True)
class SamplingConfig(ParameterSection, section="sampling"):
    """MPPI: rollouts, horizon, noise and weights."""

    samples: int = structural(128, 1, 4096, "Rollouts per instance.", symbol="K", group="Horizon", basic=True)
    steps: int = structural(
        25, 2, 200, "Time steps of the horizon.", label="Horizon steps", symbol="N", group="Horizon", basic=True
    )
    dt: float = live(0.05, "s", 0.005, 0.5, "Length of a time step.", label="Time step", symbol="dt", group="Horizon")
    temperature: float = live(
        0.1, "", 1e-3, 1e3, "Temperature of the weights: higher values average over more samples.",
        scale="log", symbol="lambda", group="Noise and weights", basic=True,
    )  # fmt: skip
    variance_thrust: float = live(
        1.0, "N^2", 0.0, 100.0, "Variance of the noise on the thrust.",
        label="Thrust noise variance", symbol="Sigma_F", group="Noise and weights", basic=True,
    )  # fmt: skip
    variance_rate_xy: float = live(
        1.0, "rad^2/s^2", 0.0, 100.0, "Variance of the noise on the roll and pitch rates.",
        label="Roll and pitch rate noise variance", symbol="Sigma_xy", group="Noise and weights", basic=True,
    )  # fmt: skip
    variance_rate_z: float = live(
        0.5, "rad^2/s^2", 0.0, 100.0, "Variance of the noise on the yaw rate.",
        label="Yaw rate noise variance", symbol="Sigma_z", group="Noise and weights",
    )  # fmt: skip
    correlation: float = live(
        0.8, "", 0.0, 0.99, "Correlation of the noise between consecutive time steps, AR(1), which yields smooth "
        "detours; 0 as in the paper.",
        label="Noise correlation", group="Noise and weights",
    )  # fmt: skip
    keep_nominal: bool = switch(
        True, "Use the nominal controls without noise as the first sample; off as in the paper.",
        label="Noise-free first sample", group="Noise and weights",
    )  # fmt: skip
    fresh_noise: bool = switch(
        True, "Draw new noise for every plan. Off, every plan uses the same noise.",
        label="New noise for every plan", group="Noise and weights",
    )  # fmt: skip
    nominal: str = choice(
        "guide", ("guide", "hover"), "Initial nominal controls: from the guide, by differential flatness, or hover.",
        label="Nominal controls", group="Planning",
    )  # fmt: skip
    nominal_lag: float = live(
        0.0, "s", 0.0, 1.0, "Time constant with which the nominal body rates of an anchor approach those that its "
        "guide requires, from those that are commanded; 0 as in the paper: at once.",
        label="Lag of nominal rates", group="Planning",
    )  # fmt: skip
    replan_period: float = live(
        0.02, "s", 0.001, 1.0, "Time between two plans, used if the vehicle states carry no time.",
        label="Replanning period", group="Planning",
    )  # fmt: skip


@dataclass(frozen=True)
class CostConfig(ParameterSection, section="costs"):
    """Weights of the costs. Stage I: S1 = J_track + J_vnorm + J_ctrl + S2. Stage II: S2 = J_goal + J_col."""

    q_position: float = live(
        3.0, "1/m", 0.0, 1e3, "Weight of the distance to the goal.",
        label="Goal position weight", symbol="Q_p", group="Goal", basic=True,
    )  # fmt: skip
    q_velocity: float = live(
        0.25, "s/m", 0.0, 1e3, "Weight of the difference to the goal velocity.",
        label="Goal velocity weight", symbol="Q_v", group="Goal", basic=True,
    )  # fmt: skip
    q_height: float = live(
        0.0, "1/m", 0.0, 1e3, "Weight of the difference in height to the goal, beyond its part of the distance; 0 as "
        "in the paper.",
        label="Height weight", symbol="Q_h", group="Goal",
    )  # fmt: skip
    q_attitude: float = live(
        1.0, "", 0.0, 1e3, "Weight of the difference to the goal attitude.",
        label="Goal attitude weight", symbol="Q_q", group="Goal",
    )  # fmt: skip
    q_vnorm: float = live(
        0.15, "s^2/m^2", 0.0, 1e3, "Weight of the squared speed.",
        label="Speed weight", symbol="Q_vnorm", group="Tracking and effort",
    )  # fmt: skip
    q_track: float = live(
        5.0, "1/m", 0.0, 1e3, "Weight of the distance to the guide; 15 in the paper.",
        label="Guide tracking weight", symbol="Q_track", group="Tracking and effort", basic=True,
    )  # fmt: skip
    q_control: float = live(
        0.5, "", 0.0, 1e3, "Weight of the squared controls.",
        label="Control effort weight", symbol="Q_c", group="Tracking and effort", basic=True,
    )  # fmt: skip
    q_control_rate: float = live(
        0.5, "", 0.0, 1e3, "Weight of the squared change of the controls between time steps.",
        label="Control change weight", symbol="Q_cd", group="Tracking and effort",
    )  # fmt: skip
    q_control_jump: float = live(
        0.0, "s^2/rad^2", 0.0, 1e3, "Weight of the squared jump from the body rates that are commanded to the first "
        "ones of a plan, also in the selection among candidates; 0 as in the paper: plans may then jump from one to "
        "the next.",
        label="Control jump weight", group="Tracking and effort",
    )  # fmt: skip
    q_speed: float = live(
        10.0, "s^2/m^2", 0.0, 1e5, "Weight of the squared excess over the speed limit; 0 as in the paper.",
        label="Speed limit weight", group="Tracking and effort",
    )  # fmt: skip
    distance_min: float = live(
        0.30, "m", 0.0, 5.0, "Clearance below which the full penalty applies; 0.4 in the paper.",
        label="Full-penalty clearance", symbol="d_min", group="Obstacles", basic=True,
    )  # fmt: skip
    distance_max: float = live(
        0.55, "m", 0.05, 5.0, "Clearance above which there is no penalty; 1.0 in the paper.",
        label="Penalty-free clearance", symbol="d_max", group="Obstacles", basic=True,
    )  # fmt: skip
    penalty: float = live(
        1e5, "", 0.0, 1e9, "Penalty of a time step with a clearance below d_min; 1e6 in the paper.",
        label="Collision penalty", symbol="C", group="Obstacles", basic=True,
    )  # fmt: skip
    shape: str = choice(
        "quadratic", ("quadratic", "exponential"),
        "Quadratic: soft_weight s^2 with s = (d_max - d) / (d_max - d_min) above d_min, and C (2 - d / d_min) below. "
        "Exponential, as in the paper: C exp(-a (d - d_min)) and C; its step at d_max turns every gap narrower than "
        "2 d_max into a wall.",
        label="Penalty shape", group="Obstacles",
    )  # fmt: skip
    decay: float = live(
        5.0, "1/m", 0.0, 100.0, "Decay rate of the exponential penalty.",
        label="Penalty decay rate", symbol="a", group="Obstacles",
    )  # fmt: skip
    soft_weight: float = live(
        100.0, "", 0.0, 1e6, "Weight of the quadratic penalty for speed limits of at least soft_speed.",
        label="Quadratic penalty weight", group="Obstacles", basic=True,
    )  # fmt: skip
    soft_speed: float = live(
        7.0, "m/s", 0.1, 50.0,
        "Speed limit below which soft_weight is scaled down in proportion: a slower drone spends more time steps in "
        "the same gap and would otherwise pay more for the passage than it is worth.",
        label="Full-weight speed limit", group="Obstacles",
    )  # fmt: skip
    use_ground: bool = switch(
        True, "Treat the ground as an obstacle where its height is known: a LiDAR may not see what is below it. Off as "
        "in the paper.",
        label="Avoid the ground", group="Obstacles",
    )  # fmt: skip
    height_min: float = live(
        -1e5, "m", -1e5, 1e5, "Lower end of the band of heights, world frame, which counts as an obstacle.",
        label="Lowest height", group="Obstacles",
    )  # fmt: skip
    height_max: float = live(
        1e5, "m", -1e5, 1e5, "Upper end of the band of heights, world frame, which counts as an obstacle.",
        label="Greatest height", group="Obstacles",
    )  # fmt: skip
    q_blocked: float = live(
        300.0, "1/m", 0.0, 1e6, "Weight of the cost-to-go, the blocked length of the path from the final state to the "
        "goal; 0 in the paper.",
        label="Blocked path weight", group="Cost-to-go", basic=True,
    )  # fmt: skip
    waypoint_distance: float = live(
        6.0, "m", 0.0, 30.0,
        "Distance from the drone up to which that path follows the direction of the anchor, before it turns to the "
        "goal. Guides that end sooner, such as slow ones, do not lead around an obstacle by themselves. 0 turns to the "
        "goal immediately.",
        label="Waypoint distance", group="Cost-to-go",
    )  # fmt: skip
    blocked_range: float = live(
        5.0, "m", 0.5, 20.0, "Length of the path that is checked for obstacles.",
        label="Cost-to-go range", group="Cost-to-go",
    )  # fmt: skip
    blocked_radius: float = live(
        0.35, "m", 0.0, 5.0, "Clearance below which the path counts as blocked.",
        label="Cost-to-go clearance", group="Cost-to-go",
    )  # fmt: skip


@dataclass(frozen=True)
class EscapeConfig(ParameterSection, section="escape"):
    """Memory of places without progress, which leads out of dead ends."""

    q_escape: float = live(
        120.0, "1/m", 0.0, 1e4, "Weight of the depth of a rollout's end in the neighbourhood of each remembered place; "
        "0 as in the paper.",
        label="Escape weight", basic=True,
    )  # fmt: skip
    radius: float = live(
        4.0, "m", 0.1, 20.0, "Radius of the neighbourhood of a remembered place. The goal has one of half this radius, "
        "in which the weight of all places fades out.",
    )  # fmt: skip
    ahead: float = live(
        2.0, "m", 0.01, 1e3, "Distance by which a rollout must end nearer to the goal than the drone has been, so that "
        "the remembered places cost nothing there: it leads to a way out. Ends that are nearer by less cost a part. "
        "1000 m: the places cost as much anywhere.",
        label="Distance ahead without escape cost",
    )  # fmt: skip
    rise: float = live(
        4.0, "", 1.0, 5.0, "Factor on the spacing of the rows of anchors, instead of anchors.slow_rise, for a slow "
        "drone near a remembered place: the way out may lead upward.",
        label="Rise factor near a place",
    )  # fmt: skip
    guide_depth: float = live(
        20.0, "m", 0.0, 400.0, "Sum of the depths in the neighbourhoods of remembered places above which a slow drone "
        "is stuck: its guides end before what is seen, since a guide through a wall does not lead out. 400 m switches "
        "this off.",
        label="Depth of short guides",
    )  # fmt: skip
    guide_margin: float = live(
        0.2, "m", 0.0, 5.0, "Distance from the end of such a guide to what its fine cell measured.",
    )  # fmt: skip
    guide_min: float = live(
        0.6, "m", 0.0, 30.0, "Least length of such a guide.", label="Shortest guide",
    )  # fmt: skip
    patience: float = live(
        0.15, "s", 0.05, 10.0, "Time without progress toward the goal after which the place is remembered."
    )
    progress: float = live(
        0.3, "m", 0.01, 10.0, "Decrease of the distance to the goal that counts as progress; at most a third of what "
        "the speed limit allows in the time of patience.",
    )  # fmt: skip


RENAMED: dict[str, str] = {"costs.way_ahead": "costs.waypoint_distance"}
"""New path of each renamed parameter by its old path, which files and flags accept for one release."""

REMOVED: dict[str, str] = {
    "costs.floor": "the ground height now comes from the world or the drone, and costs.use_ground enables it",
}
"""Reason for each removed parameter by its path, which files and flags ignore for one release."""


@dataclass(frozen=True)
class PlannerConfig(SectionedConfig):
    """All parameters of the planner.

    The default is the best configuration known; `preset("paper")` is the literal paper.

    Raises:
        ValueError: a parameter is out of bounds or contradicts another one; names parameter, value and range.
    """

    renamed: ClassVar[Mapping[str, str]] = RENAMED
    removed: ClassVar[Mapping[str, str]] = REMOVED

    vehicle: VehicleConfig = field(default_factory=VehicleConfig)
    partition: PartitionConfig = field(default_factory=PartitionConfig)
    anchors: AnchorConfig = field(default_factory=AnchorConfig)
    candidates: CandidateConfig = field(default_factory=CandidateConfig)
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    costs: CostConfig = field(default_factory=CostConfig)
    escape: EscapeConfig = field(default_factory=EscapeConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        for path, low, high in (
            ("vehicle.thrust", self.vehicle.thrust_min, self.vehicle.thrust_max),
            ("costs.distance", self.costs.distance_min, self.costs.distance_max),
            ("partition.range", self.partition.range_min, self.partition.range_max),
            ("partition.view", self.partition.view_min, self.partition.view_max),
            ("costs.height", self.costs.height_min, self.costs.height_max),
        ):
            if low >= high:
                raise ValueError(f"{path}_min is {low}; it must be less than {path}_max, which is {high}.")

    @property
    def anchor_count(self) -> int:
        """Number of anchors, M_h M_v."""
        return self.anchors.columns * self.anchors.rows

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kind of each instance, length M: first the anchors, then the additional candidates."""
        additional = ("previous",) * self.candidates.previous + ("brake",) * self.candidates.brake
        return ("anchor",) * self.anchor_count + additional

    @property
    def horizon(self) -> float:
        """Length of the horizon, T = N dt [s]."""
        return self.sampling.steps * self.sampling.dt

    @property
    def farthest_range(self) -> float:
        """Range beyond which points are ignored, which grows with the speed limit [m]."""
        return max(self.partition.range_max, self.partition.range_time * self.vehicle.speed_limit)

    def structure(self) -> tuple[tuple[str, Value], ...]:
        """Return path and value of each structural parameter; configurations of equal structure can share buffers."""
        return tuple((info.path, self.get(info.path)) for info in self.parameters() if not info.live)

    @classmethod
    def presets(cls) -> dict[str, str]:
        """Return the description of each preset by name."""
        return {name: help for name, (help, _) in PRESETS.items()}

    @classmethod
    def preset(cls, name: str) -> PlannerConfig:
        """Return a preset by name.

        Raises:
            ValueError: there is no such preset; the message lists the presets.
        """
        if name not in PRESETS:
            raise ValueError(f"unknown preset {name!r}{did_you_mean(name, PRESETS)}; known: {', '.join(PRESETS)}.")
        return cls().replace(PRESETS[name][1])
