"""Parameters of the optimiser: horizon, samples and noise."""

from __future__ import annotations

from dataclasses import dataclass

from aero_planner.parameters import ParameterSection, live, structural


@dataclass(frozen=True)
class SamplingConfig(ParameterSection, section="sampling"):
    """MPPI: rollouts, horizon, noise and weights."""

    samples: int = structural(128, 1, 4096, "Rollouts per instance.", symbol="K", group="Horizon", basic=True)
    steps: int = structural(
        25, 2, 200, "Time steps of the horizon.", label="Horizon steps", symbol="N", group="Horizon"
    )
    dt: float = live(
        0.045, "s", 0.005, 0.5, "Length of a time step; 0.05 in the paper.",
        label="Time step", symbol="dt", group="Horizon",
    )  # fmt: skip
    temperature: float = live(
        0.003, "", 1e-3, 1e3, "Temperature of the weights: higher values average over more samples; 0.1 in the paper.",
        scale="log", symbol="lambda", group="Noise and weights", basic=True,
    )  # fmt: skip
    variance_thrust: float = live(
        0.5, "N^2", 0.0, 100.0, "Variance of the noise on the thrust; 1 in the paper.",
        label="Thrust noise variance", symbol="Sigma_F", group="Noise and weights",
    )  # fmt: skip
    variance_rate_xy: float = live(
        2.0, "rad^2/s^2", 0.0, 100.0, "Variance of the noise on the roll and pitch rates; 1 in the paper.",
        label="Roll and pitch rate noise variance", symbol="Sigma_xy", group="Noise and weights",
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
    replan_period: float = live(
        0.02, "s", 0.001, 1.0, "Time between two plans, used if the vehicle states carry no time.",
        label="Replanning period", group="Planning",
    )  # fmt: skip
