"""Parameters of the errors of the state estimate."""

from __future__ import annotations

from dataclasses import dataclass

from aero_planner.parameters import ParameterSection, live


@dataclass(frozen=True)
class StateNoise(ParameterSection, section="noise"):
    """Errors of the state estimate: standard deviations per axis of first-order processes, 0 for no error.

    Sweeps are placed by the estimated pose, as on the drone, so that they share its error at the time of each point.

    Raises:
        ValueError: a parameter is outside its bounds.
    """

    position: float = live(0.0, "m", 0.0, 100.0, "Standard deviation of the position error.", label="Position error")
    velocity: float = live(0.0, "m/s", 0.0, 100.0, "Standard deviation of the velocity error.", label="Velocity error")
    attitude: float = live(
        0.0,
        "deg",
        0.0,
        180.0,
        "Standard deviation of the attitude error, a rotation vector in body axes.",
        label="Attitude error",
    )
    correlation_time: float = live(1.0, "s", 1e-3, 1e9, "Time in which an error decays to 1/e.")
