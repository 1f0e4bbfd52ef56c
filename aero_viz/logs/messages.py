"""Messages of the flight log. Their topics, types and encoding are those of the drone's own log."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from aero_planner import VehicleState
from aero_planner.onboard.ros_messages import Encoded, goal_message, plan_messages, sweep
from aero_planner.quaternions import rotation_matrix
from aero_viz.session.frame import Frame

__all__ = ["body_rates", "encode_goal", "encode_plan", "encode_sweep"]


def body_rates(before: VehicleState, after: VehicleState, time: float) -> NDArray[np.float64]:
    """Return the constant body rates [rad/s], [3], that rotate one attitude into the other within `time` [s]."""
    (w0, *v0), (w1, *v1) = np.asarray(before.quaternion, float), np.asarray(after.quaternion, float)
    w = w0 * w1 + np.dot(v0, v1)  # conj(q0) (x) q1
    v = (w0 * np.array(v1) - w1 * np.array(v0) - np.cross(v0, v1)) * (1.0 if w >= 0.0 else -1.0)
    sine = float(np.linalg.norm(v))
    return v * (2.0 * np.arctan2(sine, abs(w)) / (sine * time)) if sine > 0.0 else v


def encode_sweep(frame: Frame, points: NDArray[np.float32], stamp: int) -> Encoded:
    """Return the message on /sweep: points in the body frame at the time of the frame.

    The message has no per-point times: motion within the sweep is already compensated, and a reader that deskewed the
    points again would smear them.

    Args:
        frame: frame with the state of the drone.
        points: [m], [P, 3], world frame.
        stamp: [ns].
    """
    state = frame.observation.actual_state
    in_body = (points - np.asarray(state.position, float)) @ rotation_matrix(np.asarray(state.quaternion, float))
    return sweep(in_body.astype(np.float32), stamp)


def encode_goal(frame: Frame, stamp: int) -> Encoded:
    """Return the message on /goal; `stamp` in [ns]."""
    return goal_message(frame.observation.goal, stamp)


def encode_plan(frame: Frame, stamp: int) -> Iterator[Encoded]:
    """Yield the messages of the plan, with guides and rollouts; `stamp` in [ns]."""
    plan_ms = float(frame.timings_ms.get("plan", 0.0))
    return plan_messages(frame.plan, stamp, plan_ms=plan_ms, config_version=frame.config_version)
