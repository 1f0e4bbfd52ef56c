"""The one rule by which a candidate counts as safe: that of the planner's selection."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp
from numpy.typing import NDArray

from aero_planner import Planner, PlanStatus
from aero_planner.arrays import fine_shape
from aero_planner.device.kernel_tuning import CPU
from aero_planner.kernels.movers import Movers
from aero_planner.kernels.mppi import PROBES
from aero_planner.device.records import DroneState, Rollouts, bundle
from aero_planner.kernels.stop_proof import evaluate_stops
from aero_planner.kernels.stops import roll_out_stops

if TYPE_CHECKING:
    from aero_viz.session.frame import Frame

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Safety:
    """Measurements of the planner on M candidates, and its demands on them."""

    nearest: Array
    """Least clearance of each, less the margin for its speed [m], shape [M]. Moving obstacles that are near at the
    start count as farther away."""
    safe_clearance: float
    """Clearance that is demanded of them [m]; less than candidates.safe_clearance where a static obstacle is nearer
    than that at the start."""
    stop_clearance: Array | None
    """Largest clearance of the stops of each candidate [m], shape [M]; None if no stop is proven."""
    clear_stop: float
    """Clearance that is demanded of a stop [m]."""
    is_safe: NDArray[np.bool_]
    """Shape [M]. A braking sequence that is flown in place of a candidate is none that counts as safe."""


def judge(planner: Planner, *, best: int, status: int) -> Safety:
    """Judge every candidate of the planner's last plan, also those that its choice did not need.

    Args:
        planner: planner of one drone.
        best: candidate that it chose.
        status: status of the plan.
    """
    work, candidates = planner.workspace, planner.config.candidates
    count = len(planner.config.kinds)
    nearest = work.instance_scores.numpy()[0, :count, 1].astype(np.float64)
    start = float(work.standing_clearance.numpy()[0, 0, -1])
    safe = _demanded(candidates.safe_clearance, start, 0.02)
    clear_stop = _demanded(min(candidates.stop_clearance, candidates.safe_clearance), start, 0.005)
    stops, is_safe = None, nearest >= safe
    if candidates.prove_stop != "off":
        stops = _clearance_of_all_stops(planner).reshape(count, -1).max(axis=1)
        is_safe = (stops >= clear_stop) & (is_safe | (candidates.prove_stop == "instead"))
    if status == PlanStatus.NO_SAFE_CANDIDATE and candidates.prefer_safe:
        is_safe[:] = False
    is_safe[best] = status == PlanStatus.OK
    return Safety(nearest, safe, stops, clear_stop, is_safe)


def known_safe(frame: Frame) -> NDArray[np.bool_]:
    """Return False for each candidate that is unsafe as far as a frame tells, shape [M].

    A frame without `is_safe`, such as that of a drone, tells less: the planner looks for a clear stop in the order of
    the costs until a candidate has one, and leaves out the others.
    """
    if frame.is_safe is not None:
        return frame.is_safe
    plan, candidates = frame.plan, frame.config.candidates
    is_safe = np.ones(len(plan.kinds), dtype=np.bool_)
    if candidates.prove_stop != "instead":
        is_safe = plan.clearance.min(axis=1) >= candidates.safe_clearance
    if candidates.prefer_safe and plan.status == PlanStatus.OK:
        is_safe &= plan.stage2_cost >= plan.stage2_cost[int(plan.best)]
    elif candidates.prefer_safe and plan.status == PlanStatus.NO_SAFE_CANDIDATE:
        is_safe[:] = False
    is_safe[int(plan.best)] = plan.status == PlanStatus.OK
    return is_safe


def _demanded(limit: float, start: float, gain: float) -> float:
    """Return the clearance to demand [m]: a drone that starts with less must not come any nearer."""
    at_start = np.float32(start)
    return float(at_start - np.float32(gain) if at_start < np.float32(limit) else np.float32(limit))


def _clearance_of_all_stops(planner: Planner) -> Array:
    """Return the clearance of every stop of the last plan [m], shape [M STOPS].

    On a CPU the planner itself evaluates only those that its choice needs.
    """
    i, o, w, config = planner.inputs, planner.outputs, planner.workspace, planner.config
    if not planner.device.startswith("cpu"):
        return w.stop_clearance.numpy()[0].astype(np.float64)
    names = ("position", "velocity", "quaternion", "acceleration", "command", "control")
    drone = bundle(DroneState, **{name: getattr(w, name) for name in names}, disturbance=o.disturbance, drag=o.drag)
    moving = {name: getattr(o, f"mover_{name}") for name in ("count", "position", "velocity", "radius")}
    movers = bundle(Movers, **moving)
    names = ("controls", "positions", "velocities", "quaternions")
    rollouts = bundle(Rollouts, **{name: getattr(o, name) for name in names})
    count, (rows, columns) = w.stop_clearance.shape[1], fine_shape(config)
    outputs = [wp.empty_like(array) for array in (w.stop_controls, w.stop_positions, w.stop_clearance)]
    with wp.ScopedDevice("cpu"):
        inputs = [w.finished, drone, planner.params, w.plan_period, rollouts]
        wp.launch(roll_out_stops(CPU), (1, count), inputs=inputs, outputs=outputs)
        inputs = [w.finished, i.position, i.quaternion, i.ground_height, movers, planner.params, int(PROBES), 1]
        inputs += [rows, columns, o.fine_range, o.positions, w.plan_period, w.cell_ends, w.point_packs, outputs[1]]
        inputs += [w.state_terms, w.standing_clearance]
        wp.launch(evaluate_stops(CPU), (1, count, 4 * config.sampling.steps, 1), inputs=inputs, outputs=outputs[2:])
    return outputs[2].numpy()[0].astype(np.float64)
