"""Parameters of the optimiser: horizon, samples and noise."""

from __future__ import annotations

from dataclasses import dataclass

from aero_planner.parameters import ParameterSection, live, structural


@dataclass(frozen=True)
class SamplingConfig(ParameterSection, section="sampling"):
    """MPPI: rollouts, horizon, noise and weights."""

    samples: int = structural(
        256, 1, 4096, "Rollouts per instance; 128 in the paper.", symbol="K", group="Horizon", basic=True
    )  # fmt: skip
    steps: int = structural(
        25, 2, 200, "Time steps of the horizon.", label="Horizon steps", symbol="N", group="Horizon"
    )
    dt: float = live(
        0.045, "s", 0.005, 0.5, "Length of a time step; 0.05 in the paper.",
        label="Time step", symbol="dt", group="Horizon",
    )  # fmt: skip
    temperature: float = live(
        30.0, "", 1e-3, 1e3, "Temperature of the weights, the largest one if effective_samples is not 0: higher "
        "values average over more samples; 0.1 in the paper.",
        scale="log", symbol="lambda", group="Noise and weights",
    )  # fmt: skip
    effective_samples: float = live(
        12.0, "", 0.0, 4096.0, "Samples over which the weights average, whatever the scale of the costs: the "
        "temperature of each instance is lowered until 1 / sum(w^2) is this number. 0, as in the paper: it is fixed.",
        label="Effective samples", symbol="K_eff", group="Noise and weights", basic=True,
    )  # fmt: skip
    variance_thrust: float = live(
        0.5, "N^2", 0.0, 100.0, "Variance of the noise on the thrust; 1 in the paper.",
        label="Thrust noise variance", symbol="Sigma_F", group="Noise and weights",
    )  # fmt: skip
    variance_rate_xy: float = live(
        1.0, "rad^2/s^2", 0.0, 100.0, "Variance of the noise on the roll and pitch rates.",
        label="Roll and pitch rate noise variance", symbol="Sigma_xy", group="Noise and weights",
    )  # fmt: skip
    variance_rate_z: float = live(
        0.5, "rad^2/s^2", 0.0, 100.0, "Variance of the noise on the yaw rate.",
        label="Yaw rate noise variance", symbol="Sigma_z", group="Noise and weights",
    )  # fmt: skip
    correlation: float = live(
        0.95, "", 0.0, 0.99, "Correlation of the noise between consecutive time steps, AR(1), which yields smooth "
        "detours; 0 as in the paper.",
        label="Noise correlation", group="Noise and weights",
    )  # fmt: skip
