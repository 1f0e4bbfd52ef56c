"""PX4's log of a flight (ULog): errors of the estimate, saturation of the motors, and the response to setpoints."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_planner.onboard.lag_identification import identify_lag
from aero_planner.quaternions import rotate
from aero_viz.errors import UserError
from aero_viz.extras import from_extra

_OFFBOARD = 14  # vehicle_status.nav_state
_SATURATED = 0.99  # of a motor's range
_PERIOD = 0.01  # [s] of the resampled signals
_CHANGE = 0.05  # [rad/s] beyond which a change of sign counts


@dataclass(frozen=True)
class Px4LogSummary:
    """Summary of PX4's log while it was in OFFBOARD."""

    offboard_time: float
    """[s]"""
    position_error: float
    """Largest horizontal error of the estimated position, less the error at the beginning [m]."""
    height_error: float
    """The same for the height [m]."""
    velocity_error: float
    """Root mean square of the error of the estimated velocity [m/s]."""
    tilt_error: float
    """Root mean square of the error of the estimated direction of gravity [rad]."""
    rate_lags: tuple[float, float, float]
    """Time constants of the body rates' response, roll, pitch, yaw [s]; NaN where they did not change."""
    sign_changes: tuple[float, float, float]
    """Changes of sign of the rate setpoints, roll, pitch, yaw [1/s]."""
    saturated: float
    """Fraction of the time in which at least one motor was at a limit."""
    hover_thrust: float
    """PX4's last estimate of the hover thrust before OFFBOARD ended; NaN without one."""
    speed_at_end: float
    """True speed when OFFBOARD ended [m/s]; NaN if it did not end, or without the true state."""
    tilt_at_end: float
    """Angle between the vehicle's axis and the vertical then [rad]."""

    def to_dict(self) -> dict[str, Any]:
        """Return the fields in types that JSON has: None in place of NaN."""
        return {name: _without_nan(value) for name, value in vars(self).items()}


def load_reader() -> Any:
    """Return pyulog's class that reads a log.

    Raises:
        UserError: pyulog is not installed.
    """
    with from_extra("px4", "Logs of PX4"):
        from pyulog import ULog
    return ULog


def summarize_log(path: Path) -> Px4LogSummary | None:
    """Return the summary of a log, or None if the vehicle was never in OFFBOARD, or only at the end of the log.

    Raises:
        UserError: pyulog is not installed, or the file cannot be read.
    """
    reader = load_reader()
    try:
        log = reader(str(path))
    except Exception as error:  # pyulog raises many kinds for a damaged file
        raise UserError(f"PX4's log {path} cannot be read: {error}") from error
    topics = {topic.name: topic.data for topic in log.data_list if topic.multi_id == 0}
    status = topics.get("vehicle_status")
    if status is None or not (status["nav_state"] == _OFFBOARD).any():
        return None
    offboard = status["nav_state"] == _OFFBOARD
    begin = 1e-6 * float(status["timestamp"][offboard][0])
    later = 1e-6 * status["timestamp"][np.argmax(offboard) :][~offboard[np.argmax(offboard) :]]
    end = float(later[0]) if len(later) else 1e-6 * float(log.last_timestamp)
    times = np.arange(begin, end, _PERIOD)
    if len(times) < 2:
        return None
    estimate, truth = (
        _sampled(topics, name, ("x", "y", "z", "vx", "vy", "vz"), times)
        for name in ("vehicle_local_position", "vehicle_local_position_groundtruth")
    )
    error = estimate - truth
    moved = error[:, :3] - error[0, :3]
    down = [_down(topics, name, times) for name in ("vehicle_attitude", "vehicle_attitude_groundtruth")]
    tilt = np.linalg.norm(np.cross(down[0], down[1]), axis=1)
    at_end = np.array([end])
    last_velocity = _sampled(topics, "vehicle_local_position_groundtruth", ("vx", "vy", "vz"), at_end)[0]
    last_down = _down(topics, "vehicle_attitude_groundtruth", at_end)[0]
    wanted = _sampled(topics, "vehicle_rates_setpoint", ("roll", "pitch", "yaw"), times)
    rates = _sampled(topics, "vehicle_angular_velocity", ("xyz[0]", "xyz[1]", "xyz[2]"), times)
    motors = _sampled(topics, "actuator_motors", tuple(f"control[{number}]" for number in range(4)), times)
    return Px4LogSummary(
        offboard_time=end - begin,
        position_error=float(np.linalg.norm(moved[:, :2], axis=1).max()),
        height_error=float(np.abs(moved[:, 2]).max()),
        velocity_error=_rms(np.linalg.norm(error[:, 3:], axis=1)),
        tilt_error=_rms(tilt),
        rate_lags=tuple(_lag(times, wanted[:, k], rates[:, k]) for k in range(3)),  # type: ignore[arg-type]
        sign_changes=tuple(count_sign_changes(wanted[:, k]) / (end - begin) for k in range(3)),  # type: ignore[arg-type]
        saturated=float(((motors <= 1.0 - _SATURATED) | (motors >= _SATURATED)).any(axis=1).mean()),
        hover_thrust=_hover_thrust(topics, end),
        speed_at_end=float(np.linalg.norm(last_velocity)) if len(later) else math.nan,
        tilt_at_end=math.acos(min(max(float(last_down[2]), -1.0), 1.0)) if len(later) else math.nan,
    )


def _sampled(
    topics: dict[str, Any], name: str, fields: tuple[str, ...], times: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return fields of a topic at `times` [s], shape [n, fields]; NaN if the log lacks the topic."""
    data = topics.get(name)
    if data is None:
        return np.full((len(times), len(fields)), math.nan)
    return np.stack([np.interp(times, 1e-6 * data["timestamp"], data[field]) for field in fields], axis=1)


def _down(topics: dict[str, Any], name: str, times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the direction of gravity in the body frame at `times` [s] by a topic with attitudes, shape [n, 3]."""
    attitude = _sampled(topics, name, ("q[0]", "q[1]", "q[2]", "q[3]"), times)
    return rotate(attitude * [1.0, -1.0, -1.0, -1.0], [0.0, 0.0, 1.0])


def _hover_thrust(topics: dict[str, Any], end: float) -> float:
    """Return the last estimate before `end` [s]; PX4 logs NaN once it has disarmed."""
    data = topics.get("hover_thrust_estimate")
    if data is None:
        return math.nan
    values = data["hover_thrust"][1e-6 * data["timestamp"] <= end]
    values = values[np.isfinite(values)]
    return float(values[-1]) if len(values) else math.nan


def _without_nan(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_without_nan(item) for item in value]
    return value if math.isfinite(value) else None


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values * values)))


def _lag(times: NDArray[np.float64], wanted: NDArray[np.float64], measured: NDArray[np.float64]) -> float:
    try:
        return identify_lag(times, wanted, measured)
    except ValueError:
        return math.nan


def count_sign_changes(rates: NDArray[np.float64]) -> int:
    """Return how often the sign of a sequence of rates [rad/s], shape [n], changes; values near zero do not count."""
    signs = np.sign(rates[np.abs(rates) > _CHANGE])
    return int((np.diff(signs) != 0).sum())
