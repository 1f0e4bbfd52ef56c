"""The check of a PX4 log (ULog): its parameters and the measured hover thrust against the node's requirements."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from aero_planner.check_report import Check, CheckReport
from aero_planner.onboard.px4_parameters import check_parameters
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.user_file import open_user_file
from aero_viz.errors import UserError
from aero_viz.recordings.pose_files import ULOG_MAGIC, load_ulog, read_in_process

_HOVER_TOPIC = "hover_thrust_estimate"


def is_px4_log(path: Path) -> bool:
    """Return True if a file starts as a log of PX4."""
    try:
        with open_user_file(path) as file:
            return file.read(len(ULOG_MAGIC)) == ULOG_MAGIC
    except OSError:
        return False


def check_px4_log(path: Path) -> CheckReport:
    """Return the check of a log: the hover thrust, and every parameter that `aero-planner preflight` checks.

    The node's settings are the defaults, with the hover thrust that PX4 estimated.

    Raises:
        UserError: the log cannot be read.
    """
    parameters, hover = read_in_process(_read_values, path)
    onboard = OnboardConfig()
    if hover is None:
        advice = f"Log {_HOVER_TOPIC}, and hover for some seconds."
        check = Check("hover thrust", "not estimated in this log", ok=False, required=False, advice=advice)
    else:
        onboard = onboard.replace({"thrust.hover_thrust": float(np.clip(hover, 0.05, 0.95))})
        check = Check("hover thrust", f"{hover:.3f}, PX4's estimate: set thrust.hover_thrust to it")
    return CheckReport(
        (check, *check_parameters(parameters, onboard)),
        "The log fits the node's default settings.",
        "A parameter is wrong for the node; see FAIL above and docs/onboard.md.",
    )


def _read_values(path: Path) -> tuple[dict[str, float], float | None]:
    """Return the parameters at the end of a log, and the median of the estimated hover thrusts or None."""
    log = load_ulog(path, [_HOVER_TOPIC])
    try:
        parameters = {name: float(value) for name, value in log.initial_parameters.items()}
        parameters |= {name: float(value) for _, name, value in log.changed_parameters}
        values = [entry.data["hover_thrust"] for entry in log.data_list]
    except (KeyError, ValueError) as error:
        raise UserError(f"{path} cannot be read and may be damaged: a topic or parameter lacks {error}.") from error
    values = np.concatenate([np.zeros(0), *values])
    values = values[np.isfinite(values) & (values > 0.0)]
    return parameters, float(np.median(values)) if len(values) else None
