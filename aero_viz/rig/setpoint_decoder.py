"""Setpoints for the autopilot, as they arrive in SET_ATTITUDE_TARGET."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from aero_planner.onboard.frames import attitude_from_ned, flu_from_frd
from aero_viz.rig.offboard import Mode, Setpoint

PILOT_MESSAGES = ("SET_MODE", "COMMAND_INT", "MANUAL_CONTROL", "RC_CHANNELS_OVERRIDE", "PARAM_SET")
"""Messages that only the pilot may send."""


def decode_setpoint(
    message: Any, dialect: Any, *, time: float, mode: Mode, force: Callable[[float], float], system: int = 1
) -> Setpoint | None:
    """Return the setpoint in a message; None if it is incomplete, not finite, or for another component.

    Args:
        message: a SET_ATTITUDE_TARGET.
        dialect: pymavlink's module of the messages.
        time: time of arrival, since the start of the simulation [s].
        mode: mode at that time.
        force: returns the total thrust [N] for a thrust setpoint in [0, 1].
        system: system id of the autopilot.
    """
    mask = message.type_mask
    rates_ignored = (
        dialect.ATTITUDE_TARGET_TYPEMASK_BODY_ROLL_RATE_IGNORE
        | dialect.ATTITUDE_TARGET_TYPEMASK_BODY_PITCH_RATE_IGNORE
        | dialect.ATTITUDE_TARGET_TYPEMASK_BODY_YAW_RATE_IGNORE
    )
    has_attitude = not mask & dialect.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE
    has_rates = not mask & rates_ignored
    is_addressed = message.target_system in (0, system) and message.target_component in (0, 1)
    rates = [message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate]
    values = [message.thrust, *(rates if has_rates else []), *(message.q if has_attitude else [])]
    is_complete = (has_attitude or has_rates) and not mask & dialect.ATTITUDE_TARGET_TYPEMASK_THROTTLE_IGNORE
    if not (is_complete and is_addressed and np.isfinite(values).all()):
        return None
    return Setpoint(
        time,
        force(min(max(message.thrust, 0.0), 1.0)),
        tuple(flu_from_frd(rates).tolist()) if has_rates else None,
        tuple(attitude_from_ned(message.q).tolist()) if has_attitude else None,
        mode,
    )
