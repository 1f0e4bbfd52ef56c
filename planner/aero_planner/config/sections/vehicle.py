"""Parameters of the vehicle and of its model."""

from __future__ import annotations

from dataclasses import dataclass

from aero_planner.parameters import ParameterSection, choice, live
from aero_planner.registry import names


@dataclass(frozen=True)
class VehicleConfig(ParameterSection, section="vehicle"):
    """Vehicle: its model and its limits."""

    model: str = choice(
        "ctbr", names("models"), "Vehicle model: what the controls are, and how the state follows them. ctbr, as in "
        "the paper: thrust and body rates. acceleration: acceleration and yaw rate, for autopilots that take these.",
        label="Vehicle model", live=False,
    )  # fmt: skip
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
    rate_lag: float = live(
        0.0, "s", 0.0, 1.0, "Time constant with which the body rates follow their commands; 0 as in the paper. 0.07 s "
        "for PX4.",
        label="Body rate lag", symbol="tau_omega",
    )  # fmt: skip
    delay: float = live(
        0.0, "s", 0.0, 0.5, "Time from a command to its effect: the latency, and the lag of the body rates where "
        "rate_lag does not model it. Plans start from the state that is predicted for it.",
        label="Delay of commands",
    )  # fmt: skip
    speed_limit: float = live(
        7.0, "m/s", 0.2, 50.0,
        "Speed to stay below. It limits the look-ahead distance to 0.6 T v, the length at which a guide asks for no "
        "more speed, and costs.q_speed penalizes the excess.", basic=True,
    )  # fmt: skip

    def unmodelled_delay(self, *, rate_lag: float, latency: float = 0.0) -> float:
        """Return the delay [s] with which to plan for a drone with a lag of its body rates and a latency [s].

        The lag is left out if `rate_lag` models it.
        """
        delay = latency + (rate_lag if self.rate_lag == 0.0 else 0.0)
        return min(round(delay, 9), 0.5)  # people read it: 0.09, not the 0.09000000000000001 of 0.02 + 0.07
