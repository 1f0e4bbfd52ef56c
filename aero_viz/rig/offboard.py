"""Model of how PX4 obeys setpoints of attitude and body rates in OFFBOARD.

PX4 has one controller for the attitude and one for the body rates, and its commander selects one of them. A setpoint of
another kind selects the other controller, but late: until then the previous one continues with the last setpoint that
it can use. A message with attitude and rates feeds both.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aero_planner.quaternions import conjugate, multiply

_SWITCH_TIME = 0.4
"""Time from the first setpoint of another kind until its controller is selected, as seen with PX4 1.17 [s]."""
_GAINS = np.array([6.5, 6.5, 2.8])
"""Rates per attitude error about the body axes: PX4's MC_ROLL_P, MC_PITCH_P and MC_YAW_P [1/s]."""
_RATES_MAX = np.radians([220.0, 220.0, 200.0])
"""Largest rates that the attitude controller asks for: MC_ROLLRATE_MAX, MC_PITCHRATE_MAX, MC_YAWRATE_MAX [rad/s]. They
do not bound rates that arrive as setpoints."""


class Mode(enum.Enum):
    """Flight mode. The value is PX4's custom mode."""

    HOLD = 4 << 16 | 3 << 24
    """The autopilot controls the vehicle: it brakes and holds its position."""
    OFFBOARD = 6 << 16
    """The companion computer controls the vehicle."""


@dataclass(frozen=True)
class Setpoint:
    """A decoded SET_ATTITUDE_TARGET with rates, attitude, or both."""

    time: float
    """Time of arrival at the kernel, since the start of the simulation [s]."""
    thrust: float
    """Total thrust [N]."""
    rates: tuple[float, float, float] | None
    """Body rates [rad/s], forward-left-up."""
    attitude: tuple[float, float, float, float] | None
    """Body to world, w x y z."""
    mode: Mode
    """Mode at the time of arrival. The autopilot obeys in OFFBOARD only."""


class OffboardControl:
    """Turns setpoints into thrust and body rates."""

    def __init__(self) -> None:
        self._rates: Setpoint | None = None
        self._attitude: Setpoint | None = None
        self._newest: Setpoint | None = None
        self._uses_attitude = False
        self._changes_at: float | None = None

    def receive(self, setpoint: Setpoint, now: float) -> None:
        """Receive a setpoint at the time `now` [s]."""
        self._newest = setpoint
        self._rates = setpoint if setpoint.rates is not None else self._rates
        self._attitude = setpoint if setpoint.attitude is not None else self._attitude
        if (setpoint.attitude is not None) is self._uses_attitude:
            self._changes_at = None
        elif self._changes_at is None:
            self._changes_at = now + _SWITCH_TIME

    def engage(self) -> None:
        """Begin with the controller for the newest setpoint."""
        self._uses_attitude = self._newest is not None and self._newest.attitude is not None
        self._changes_at = None

    def control(self, quaternion: NDArray[np.float64], now: float) -> NDArray[np.float64]:
        """Return thrust [N] and body rates [rad/s], shape [4], for an attitude at the time `now` [s]."""
        if self._changes_at is not None and now >= self._changes_at:
            self._uses_attitude, self._changes_at = not self._uses_attitude, None
        setpoint = self._attitude if self._uses_attitude else self._rates
        assert setpoint is not None
        if not self._uses_attitude:
            assert setpoint.rates is not None
            return np.array([setpoint.thrust, *setpoint.rates])
        assert setpoint.attitude is not None
        error = multiply(conjugate(quaternion), np.array(setpoint.attitude))
        # PX4: twice the vector part, with the sign of the shorter way.
        rates = _GAINS * 2.0 * np.copysign(1.0, error[0]) * error[1:]
        return np.array([setpoint.thrust, *np.clip(rates, -_RATES_MAX, _RATES_MAX)])
