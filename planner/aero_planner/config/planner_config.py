"""Every parameter of the planner: default, unit, bounds, help, and whether it is live or structural.

A *live* parameter sits in device memory and can change between two plans at no cost. A *structural* one sizes buffers
or selects kernels; changing it rebuilds the planner. Sliders, command line flags, YAML files and the documentation
derive from the fields below. Symbols are the paper's.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from aero_planner.config.parameter import (
    ParameterInfo,
    ParameterSection,
    SectionedConfig,
    Value,
    choice,
    did_you_mean,
    live,
    structural,
    switch,
)

__all__ = [
    "AnchorConfig",
    "CandidateConfig",
    "CostConfig",
    "ParameterInfo",
    "PartitionConfig",
    "PlannerConfig",
    "SamplingConfig",
    "VehicleConfig",
    "parameters",
]


@dataclass(frozen=True)
class VehicleConfig(ParameterSection, section="vehicle"):
    """The quadrotor."""

    mass: float = live(1.0, "kg", 0.05, 50.0, "Mass.", scale="log", symbol="m")
    gravity: float = live(9.81, "m/s^2", 0.0, 30.0, "Gravity.", symbol="g")
    thrust_min: float = live(0.3, "N", 0.0, 500.0, "Smallest total thrust.", symbol="F_min")
    thrust_max: float = live(16.35, "N", 0.1, 1000.0, "Largest total thrust.", symbol="F_max")
    rate_xy_max: float = live(3.0, "rad/s", 0.1, 20.0, "Largest roll and pitch rate.", symbol="omega_xy")
    rate_z_max: float = live(2.0, "rad/s", 0.1, 20.0, "Largest yaw rate.", symbol="omega_z")
    speed_limit: float = live(
        7.0, "m/s", 0.2, 50.0,
        "Speed to stay under. It bounds the look-ahead by 0.6 T v, the length at which a guide asks for no more speed, "
        "and costs.q_speed prices what exceeds it.",
    )  # fmt: skip


@dataclass(frozen=True)
class PartitionConfig(ParameterSection, section="partition"):
    """Spherical partition of the cloud."""

    range_max: float = live(10.0, "m", 1.0, 100.0, "Points farther than this are ignored.", symbol="r_max")
    range_min: float = live(
        0.1, "m", 0.0, 5.0, "Points nearer than this are ignored: returns from the drone itself. The paper has none."
    )
    cloud_age_max: float = live(0.5, "s", 0.05, 10.0, "Age of the cloud above which the drone brakes, where told.")
    fine_cells: int = structural(
        6, 2, 18, "Fine cells along each side of a coarse cell; 6 gives 3 deg in 18 deg.", symbol="n"
    )
    coarse_columns: int = structural(20, 8, 40, "Coarse cells around the horizon; 20 gives 18 deg.")
    coarse_rows: int = structural(10, 4, 20, "Coarse cells from straight down to straight up; 10 gives 18 deg.")


@dataclass(frozen=True)
class AnchorConfig(ParameterSection, section="anchors"):
    """Anchors: where the guides lead."""

    columns: int = structural(5, 1, 15, "Directions side by side.", symbol="M_h")
    rows: int = structural(3, 1, 9, "Directions one above the other.", symbol="M_v")
    spacing: float = live(18.0, "deg", 1.0, 45.0, "Angle between two directions.")
    lookahead: float = live(5.0, "m", 0.2, 30.0, "Distance of the anchors; never beyond the goal.", symbol="l")
    lookahead_rest: float = live(
        2.5, "m", 0.1, 30.0,
        "Distance at rest, growing by 0.6 T v with the speed v up to the look-ahead: from rest a full-length guide "
        "asks for an acceleration that saturates the thrust. At or above the look-ahead this is off, as in the paper.",
    )  # fmt: skip
    slow_spread: float = live(
        1.5, "", 1.0, 5.0, "Factor on the spacing below slow_speed, to find a way round; 1 as in the paper."
    )
    slow_speed: float = live(3.0, "m/s", 0.0, 20.0, "Speed below which slow_spread applies.")
    refine: bool = switch(True, "Move each anchor to the safe direction of its coarse cell.")
    arrival_speed: float = live(0.0, "m/s", 0.0, 20.0, "Speed at the end of a guide, along its anchor.", symbol="v_1")


@dataclass(frozen=True)
class CandidateConfig(ParameterSection, section="candidates"):
    """Instances beside the anchors."""

    previous: bool = switch(
        True, "Add the previous best plan, shifted in time and free of the tracking cost: it keeps a way once found.",
        live=False,
    )  # fmt: skip
    brake: bool = switch(True, "Add a guide that brakes, for when all others cross an obstacle.", live=False)
    safe_clearance: float = live(
        0.27, "m", 0.0, 5.0, "A candidate that comes nearer than this is not safe: the drone's radius, and a margin."
    )
    between_steps: bool = switch(
        True, "Judge what is safe half way between two steps, too: at 7 m/s they lie 0.35 m apart."
    )
    prefer_safe: bool = switch(
        True, "Let a safe candidate win over any other, and brake when none is safe. Off as in the paper: the least S2 "
        "wins, and the drone brakes when that one is not safe.",
    )  # fmt: skip
    brake_reach: float = live(
        0.35, "", 0.1, 1.0, "End of the braking guide, as a fraction of v T; the smaller, the harder it brakes."
    )
    brake_fan: float = live(
        20.0, "deg", 0.0, 45.0, "Angle between five ways to brake, of which the one that stays farthest from "
        "obstacles is flown: straight ahead may be what the drone was avoiding. 0 brakes straight ahead only.",
    )  # fmt: skip


@dataclass(frozen=True)
class SamplingConfig(ParameterSection, section="sampling"):
    """MPPI: samples, horizon, noise, weights."""

    samples: int = structural(128, 1, 4096, "Rollouts of each instance.", symbol="K")
    steps: int = structural(25, 2, 200, "Steps of the horizon.", symbol="N")
    dt: float = live(0.05, "s", 0.005, 0.5, "Length of a step.", symbol="dt")
    temperature: float = live(0.1, "", 1e-3, 1e3, "Softness of the weights.", scale="log", symbol="lambda")
    variance_thrust: float = live(1.0, "N^2", 0.0, 100.0, "Noise variance of the thrust.", symbol="Sigma_F")
    variance_rate_xy: float = live(
        1.0, "rad^2/s^2", 0.0, 100.0, "Noise variance of roll and pitch rate.", symbol="Sigma_xy"
    )
    variance_rate_z: float = live(0.5, "rad^2/s^2", 0.0, 100.0, "Noise variance of the yaw rate.", symbol="Sigma_z")
    correlation: float = live(
        0.8, "", 0.0, 0.99, "Correlation of the noise from step to step, AR(1): smooth detours; 0 as in the paper."
    )
    keep_nominal: bool = switch(True, "Let the first sample be the nominal itself, noise-free; off as in the paper.")
    fresh_noise: bool = switch(True, "Draw new noise at every plan; otherwise every plan draws the same.")
    nominal: str = choice(
        "guide", ("guide", "hover"), "Nominal controls: the guide's by differential flatness, or hovering."
    )
    replan_period: float = live(0.02, "s", 0.001, 1.0, "Time between two plans when the states carry no time.")


@dataclass(frozen=True)
class CostConfig(ParameterSection, section="costs"):
    """Weights of the costs. Stage I: S1 = J_track + J_vnorm + J_ctrl + S2. Stage II: S2 = J_goal + J_col."""

    q_position: float = live(3.0, "1/m", 0.0, 1e3, "Distance to the goal.", symbol="Q_p")
    q_velocity: float = live(0.25, "s/m", 0.0, 1e3, "Difference to the goal's velocity.", symbol="Q_v")
    q_attitude: float = live(1.0, "", 0.0, 1e3, "Difference to the goal's attitude.", symbol="Q_q")
    q_vnorm: float = live(0.15, "s^2/m^2", 0.0, 1e3, "Squared speed.", symbol="Q_vnorm")
    q_track: float = live(5.0, "1/m", 0.0, 1e3, "Distance to the guide; 15 in the paper.", symbol="Q_track")
    q_control: float = live(0.5, "", 0.0, 1e3, "Squared controls.", symbol="Q_c")
    q_control_rate: float = live(0.5, "", 0.0, 1e3, "Squared change of the controls.", symbol="Q_cd")
    q_speed: float = live(10.0, "s^2/m^2", 0.0, 1e5, "Squared excess over the speed limit; 0 as in the paper.")
    distance_min: float = live(
        0.28, "m", 0.0, 5.0, "Clearance below which the full penalty applies; 0.4 in the paper.", symbol="d_min"
    )
    distance_max: float = live(
        0.55, "m", 0.05, 5.0, "Clearance above which nothing is paid; 1.0 in the paper.", symbol="d_max"
    )
    penalty: float = live(1e5, "", 0.0, 1e9, "Penalty of a step below d_min; 1e6 in the paper.", symbol="C")
    shape: str = choice(
        "quadratic", ("quadratic", "exponential"),
        "Between d_min and d_max: soft_weight s^2 with s = (d_max - d) / (d_max - d_min), and C (2 - d / d_min) below; "
        "or the paper's C exp(-a (d - d_min)), and C below, whose step at d_max makes a wall of every gap narrower "
        "than 2 d_max.",
    )  # fmt: skip
    decay: float = live(5.0, "1/m", 0.0, 100.0, "Decay of the exponential penalty.", symbol="a")
    soft_weight: float = live(100.0, "", 0.0, 1e6, "Weight of the quadratic penalty at soft_speed and above.")
    soft_speed: float = live(
        7.0, "m/s", 0.1, 50.0,
        "Speed limit below which soft_weight shrinks in proportion: a slower drone spends more steps in the same gap, "
        "and would pay more for the passage than it is worth.",
    )  # fmt: skip
    q_blocked: float = live(
        300.0, "1/m", 0.0, 1e6, "Cost-to-go: blocked metres on the way from the last state to the goal; 0 in the paper."
    )
    way_ahead: float = live(
        3.0, "m", 0.0, 30.0,
        "That way keeps the anchor's direction until this far from the drone before it turns to the goal: guides that "
        "end nearer, as slow ones do, see no way round an obstacle by themselves. 0 turns at once.",
    )  # fmt: skip
    blocked_range: float = live(5.0, "m", 0.5, 20.0, "Length of the way that is looked at.")
    blocked_radius: float = live(0.35, "m", 0.0, 5.0, "Clearance below which the way is blocked.")
    floor: float = live(
        -1000.0, "m", -1000.0, 1000.0, "World height that counts as an obstacle from there down: the ground, for a "
        "sensor that does not see what is below it. At -1000 this is off.",
    )  # fmt: skip


@dataclass(frozen=True)
class PlannerConfig(SectionedConfig):
    """All parameters. The default is the best configuration known; `preset("paper")` is the literal paper.

    Raises:
        ValueError: a parameter is outside its bounds or contradicts another one; names field, value and range.
    """

    vehicle: VehicleConfig = field(default_factory=VehicleConfig)
    partition: PartitionConfig = field(default_factory=PartitionConfig)
    anchors: AnchorConfig = field(default_factory=AnchorConfig)
    candidates: CandidateConfig = field(default_factory=CandidateConfig)
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    costs: CostConfig = field(default_factory=CostConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        for stem in ("vehicle.thrust", "costs.distance", "partition.range"):
            low, high = self.get(f"{stem}_min"), self.get(f"{stem}_max")
            if low >= high:  # type: ignore[operator]
                raise ValueError(f"{stem}_min is {low}; it must be less than {stem}_max, which is {high}.")

    @property
    def anchor_count(self) -> int:
        """M_h M_v."""
        return self.anchors.columns * self.anchors.rows

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kind of each instance, length M: the anchors, then the other candidates."""
        others = ("previous",) * self.candidates.previous + ("brake",) * self.candidates.brake
        return ("anchor",) * self.anchor_count + others

    @property
    def horizon(self) -> float:
        """T = N dt [s]."""
        return self.sampling.steps * self.sampling.dt

    def structure(self) -> tuple[Value, ...]:
        """Return the structural values: two configurations with the same structure share buffers and kernels."""
        return tuple(self.get(info.path) for info in parameters() if not info.live)

    @classmethod
    def presets(cls) -> dict[str, str]:
        """Return the names of all presets, each with one sentence."""
        return {name: help for name, (help, _) in _PRESETS.items()}

    @classmethod
    def preset(cls, name: str) -> PlannerConfig:
        """Return a preset by name.

        Raises:
            ValueError: no such preset; the message lists them.
        """
        if name not in _PRESETS:
            raise ValueError(f"unknown preset {name!r}{did_you_mean(name, _PRESETS)}; known: {', '.join(_PRESETS)}.")
        return cls().replace(_PRESETS[name][1])


_PAPER: dict[str, Value] = {
    "vehicle.speed_limit": 50.0,
    "partition.range_min": 0.0,
    "anchors.lookahead_rest": 5.0,
    "anchors.slow_spread": 1.0,
    "candidates.previous": False,
    "candidates.brake": False,
    "candidates.safe_clearance": 0.25,
    "candidates.prefer_safe": False,
    "candidates.between_steps": False,
    "candidates.brake_fan": 0.0,
    "sampling.correlation": 0.0,
    "sampling.keep_nominal": False,
    "sampling.fresh_noise": False,
    "costs.q_track": 15.0,
    "costs.q_speed": 0.0,
    "costs.distance_min": 0.4,
    "costs.distance_max": 1.0,
    "costs.penalty": 1e6,
    "costs.shape": "exponential",
    "costs.q_blocked": 0.0,
    "costs.way_ahead": 0.0,
}

_PRESETS: dict[str, tuple[str, dict[str, Value]]] = {
    "default": ("The best configuration known.", {}),
    "paper": ("The literal paper: every number and every formula.", _PAPER),
    "fast-cpu": ("The default with a quarter of the samples, for slow machines.", {"sampling.samples": 32}),
}


def parameters() -> tuple[ParameterInfo, ...]:
    """Return every parameter of the planner, in the order of the configuration."""
    return PlannerConfig.parameters()


def find_parameter(path: str) -> ParameterInfo:
    """Return the parameter at `path`, such as "costs.q_track".

    Raises:
        ValueError: there is no such parameter; the message suggests the nearest one.
    """
    return PlannerConfig.find(path)
