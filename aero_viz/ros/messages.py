"""A plan for other programs of ROS 2, besides the messages of flight logs: candidates, cells, status, command."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner import PlanStatus
from aero_planner.onboard.ros_definitions import MARKERS
from aero_planner.onboard.ros_messages import BEST_WIDTH, BODY, WIDTH, WORLD, CdrWriter, Encoded, cloud
from aero_planner.quaternions import rotate
from aero_viz.planners.plan import Plan, cell_angles, directions_at, ensemble
from aero_viz.session.frame import Frame, end_sentence

CLEAN_ENDS = ("arrived", "end")
"""Outcomes that are no failure."""
_LETTERS = 0.12  # [m]
_STATUS = {
    PlanStatus.OK: "safe",
    PlanStatus.NO_SAFE_CANDIDATE: "no safe candidate: braking",
    PlanStatus.STALE_CLOUD: "the cloud is stale: braking",
}


def candidate_markers(plan: Plan, stamp: int) -> Encoded:
    """Return /plan/candidates: every path from green, the cheapest, to red, with its costs as a text at its end."""
    rank = np.argsort(np.argsort(plan.cost)) / max(len(plan.kinds) - 1, 1)
    colors = np.stack((rank, 1.0 - rank, np.full(len(rank), 0.2), np.ones(len(rank))), axis=1)
    writer = CdrWriter()
    writer.pack("I", 2 * len(plan.kinds))
    for i, (kind, path) in enumerate(zip(plan.kinds, plan.positions, strict=True)):
        terms = ", ".join(f"{name} {values[i]:.3g}" for name, values in plan.costs.items())
        text = f"{kind} {i}: {plan.cost[i]:.4g} ({terms})"
        width = BEST_WIDTH if i == int(plan.best) else WIDTH
        writer.marker(("candidates", i), stamp, scale=width, color=colors[i], line=path)
        writer.marker(("costs", i), stamp, scale=_LETTERS, color=colors[i], text=text, at=path[-1])
    return Encoded("/plan/candidates", MARKERS, writer.done())


def cell_cloud(frame: Frame, stamp: int) -> Encoded | None:
    """Return /plan/cells: every occupied fine cell at its range, body frame; None if the plan has no cells.

    The field "continued" is 1 for cells into which the planner continues a surface that was not measured.
    """
    if (plan := ensemble(frame.plan)) is None:
        return None
    ranges = np.asarray(plan.fine_range).reshape(-1)
    is_occupied = ranges < frame.config.farthest_range - 1e-4
    points = directions_at(*cell_angles(plan.fine_range.shape))[is_occupied] * ranges[is_occupied, None]
    is_continued = np.zeros(ranges.shape) if plan.continued_cells is None else plan.continued_cells.reshape(-1)
    more = {"range": ranges[is_occupied], "continued": is_continued[is_occupied].astype(np.uint32)}
    return cloud("/plan/cells", BODY, points, stamp, more=more)


def filtered_cloud(frame: Frame, stamp: int) -> Encoded | None:
    """Return /plan/filtered: the nearest point of each fine cell, world frame; None if the plan has no cells."""
    plan = ensemble(frame.plan)
    return None if plan is None else cloud("/plan/filtered", WORLD, np.asarray(plan.filtered_points), stamp)


def diagnostics(frame: Frame, stamp: int) -> Any:
    """Return a diagnostic_msgs/DiagnosticArray with the status of the planner; failed flights are errors."""
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

    plan, best, state = frame.plan, int(frame.plan.best), frame.observation.actual_state
    to_goal = np.asarray(frame.observation.goal.position) - np.asarray(state.position)
    values: dict[str, float | str] = {
        "status": _STATUS[PlanStatus(int(plan.status))],
        "candidate": f"{plan.kinds[best]} {best}",
        "cost": float(plan.cost[best]),
        **{f"cost of {name}": float(cost[best]) for name, cost in plan.costs.items()},
        "smallest clearance [m]": float(np.min(plan.clearance[best])),
        "distance to the goal [m]": float(np.linalg.norm(to_goal)),
        "speed [m/s]": float(np.linalg.norm(np.asarray(state.velocity))),
        "planning [ms]": float(frame.timings_ms.get("plan", np.nan)),
        "rate [Hz]": frame.rate,
        "dropped ticks": frame.dropped_ticks,
        "configuration": frame.config_version,
        "outcome": frame.outcome or "",
    }
    status = DiagnosticStatus(name="aero_viz: planner", hardware_id=frame.source.name, message=str(values["status"]))
    status.level = DiagnosticStatus.OK if plan.status == PlanStatus.OK else DiagnosticStatus.WARN
    if frame.outcome is not None:
        status.message = end_sentence(frame.source.name, frame.outcome, frame.explanation)
        status.level = DiagnosticStatus.OK if frame.outcome in CLEAN_ENDS else DiagnosticStatus.ERROR
    status.values = [KeyValue(key=key, value=_text(value)) for key, value in values.items()]
    return stamped(DiagnosticArray(status=[status]), stamp)


def velocity_command(frame: Frame, stamp: int) -> Any:
    """Return a geometry_msgs/TwistStamped: the velocity after the first step of the chosen path, and the rates."""
    from geometry_msgs.msg import TwistStamped

    plan = frame.plan
    message = stamped(TwistStamped(), stamp)
    _set(message.twist.linear, plan.velocities[int(plan.best)][1])
    rates = {"ctbr": plan.command[0][1:], "acceleration": (0.0, 0.0, plan.command[0][3])}.get(plan.model)
    if rates is not None:
        attitude = (1.0, 0.0, 0.0, 0.0) if plan.model == "acceleration" else frame.observation.state.quaternion
        _set(message.twist.angular, rotate(attitude, rates))
    return message


def acceleration_command(frame: Frame, stamp: int) -> Any:
    """Return a geometry_msgs/AccelStamped: what the first control makes of the drone; None for other vehicles."""
    from geometry_msgs.msg import AccelStamped

    if (acceleration := commanded_acceleration(frame)) is None:
        return None
    message = stamped(AccelStamped(), stamp)
    _set(message.accel.linear, acceleration)
    return message


def commanded_acceleration(frame: Frame) -> NDArray[np.float64] | None:
    """Return R(q) [0, 0, F / m] + g, or the commanded acceleration itself [m/s^2], shape [3], world frame.

    None where the control of the vehicle is neither.
    """
    control, vehicle = np.asarray(frame.plan.command[0], dtype=np.float64), frame.config.vehicle
    if frame.plan.model == "acceleration":
        return control[:3]
    if frame.plan.model != "ctbr":
        return None
    thrust = rotate(frame.observation.state.quaternion, (0.0, 0.0, control[0] / vehicle.mass))
    return thrust - (0.0, 0.0, vehicle.gravity)


def stamped(message: Any, stamp: int, frame_id: str = WORLD) -> Any:
    """Return a message with the stamp [ns] and the frame in its header."""
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
    message.header.frame_id = frame_id
    return message


def _set(vector: Any, values: ArrayLike) -> None:
    vector.x, vector.y, vector.z = np.asarray(values, dtype=np.float64).tolist()


def _text(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:.6g}"
