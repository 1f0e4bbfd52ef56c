"""Weights and shapes of the costs."""

from __future__ import annotations

from dataclasses import dataclass

from aero_planner.parameters import ParameterSection, choice, live, switch


@dataclass(frozen=True)
class CostConfig(ParameterSection, section="costs"):
    """Weights of the costs. Stage I: S1 = J_track + J_vnorm + J_ctrl + S2. Stage II: S2 = J_goal + J_col."""

    q_position: float = live(
        10.0, "1/m", 0.0, 1e3, "Weight of the distance to the goal; 3 in the paper.",
        label="Goal position weight", symbol="Q_p", group="Goal", basic=True,
    )  # fmt: skip
    q_velocity: float = live(
        0.25, "s/m", 0.0, 1e3, "Weight of the difference to the goal velocity.",
        label="Goal velocity weight", symbol="Q_v", group="Goal",
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
        3.0, "1/m", 0.0, 1e3, "Weight of the distance to the guide; 15 in the paper.",
        label="Guide tracking weight", symbol="Q_track", group="Tracking and effort", basic=True,
    )  # fmt: skip
    q_control: float = live(
        0.12, "", 0.0, 1e3, "Weight of the squared controls; 0.5 in the paper.",
        label="Control effort weight", symbol="Q_c", group="Tracking and effort", basic=True,
    )  # fmt: skip
    q_control_rate: float = live(
        0.5, "", 0.0, 1e3, "Weight of the squared change of the controls between time steps.",
        label="Control change weight", symbol="Q_cd", group="Tracking and effort",
    )  # fmt: skip
    q_control_jump: float = live(
        0.0, "s^2/rad^2", 0.0, 1e3, "Weight of the squared jump from the body rates that are commanded to the first "
        "ones of a plan, also in the selection; 0 as in the paper. Beyond 0, one sample per instance has no noise, and "
        "controls approach what a guide asks for with the lags of the vehicle.",
        label="Control jump weight", group="Tracking and effort",
    )  # fmt: skip
    q_thrust_jump: float = live(
        20.0, "1/N^2", 0.0, 1e3, "Weight of the squared jump from the thrust that is commanded to the first one of a "
        "plan, also in the selection; 0 as in the paper.",
        label="Thrust jump weight", group="Tracking and effort",
    )  # fmt: skip
    q_speed: float = live(
        200.0, "s^2/m^2", 0.0, 1e5, "Weight of the squared excess over the speed limit; 0 as in the "
        "paper.",
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
        label="Collision penalty", symbol="C", group="Obstacles",
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
        200.0, "", 0.0, 1e6, "Weight of the quadratic penalty.",
        label="Quadratic penalty weight", group="Obstacles", basic=True,
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
        300.0, "1/m", 0.0, 1e6, "Weight of the cost-to-go, the blocked length of the straight path from the final "
        "state to the goal, as far as the look-ahead distance; 0 in the paper. It is blocked where the clearance is "
        "below d_min.",
        label="Blocked path weight", group="Cost-to-go", basic=True,
    )  # fmt: skip
