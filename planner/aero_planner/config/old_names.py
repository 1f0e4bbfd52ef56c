"""Names of parameters that were renamed or removed; files and flags accept them for one release."""

from __future__ import annotations

RENAMED: dict[str, str] = {
    "partition.view_age": "unseen_space.view_age",
    "partition.continue_below": "unseen_space.continuation",
    "partition.predict": "moving_obstacles.predict",
    "partition.memory_time": "memory.memory_time",
    "partition.memory_distance": "memory.memory_distance",
    "vehicle.rate_xy_lag": "vehicle.rate_lag",
    "vehicle.disturbance_time": "disturbance.disturbance_time",
    "vehicle.drag_time": "disturbance.drag_time",
    "anchors.slow_spread": "way_out.spread",
    "escape.q_escape": "way_out.q_escape",
    "escape.radius": "way_out.radius",
    "escape.patience": "way_out.patience",
    "candidates.stop_clearance": "stop_proof.stop_clearance",
}
"""New path of each renamed parameter by its old path."""

CHANGED: dict[str, str] = {
    "partition.continue_below": "holds for both edges of the view",
    "vehicle.rate_xy_lag": "holds for all body rates",
}
"""What is different about a renamed parameter, by its old path."""

_NO_USE = "flights without it arrive as often"
_FIXED = "its default is part of the planner now"

REMOVED: dict[str, str] = {
    **dict.fromkeys(
        ("partition.view_min", "partition.view_max", "unseen_space.view_min", "unseen_space.view_max"),
        "give both edges as unseen_space.view, such as '-7 52'",
    ),
    **dict.fromkeys(
        (
            "costs.way_ahead", "costs.waypoint_distance", "costs.q_height", "costs.soft_speed",
            "partition.continue_before", "partition.predict_memory", "partition.predict_wake_speed",
            "escape.previous_discount", "escape.guide_depth", "anchors.arrival_speed", "sampling.nominal",
            "sampling.nominal_lag", "vehicle.descent_limit", "candidates.brake", "candidates.between_steps",
            "candidates.stop_seen_closing", "candidates.brake_seen", "sampling.keep_nominal",
            "anchors.lookahead_rest", "anchors.slow_cycle",
        ),
        _NO_USE,
    ),
    **dict.fromkeys(
        (
            "partition.coarse_rows", "partition.coarse_columns", "partition.predict_range", "partition.predict_speed",
            "partition.predict_width", "partition.predict_growth", "anchors.refine", "anchors.slow_speed",
            "escape.progress", "escape.guide_margin", "escape.guide_min", "candidates.stop_seen",
            "candidates.stop_speed", "candidates.brake_fan", "candidates.widest_stop", "sampling.fresh_noise",
            "escape.ahead",
        ),
        _FIXED,
    ),
    **dict.fromkeys(("anchors.slow_rise", "escape.rise", "way_out.rise"), "way_out.spread holds for the rows, too"),
    "sampling.replan_period": "states without a time count as 0.02 s apart; give VehicleState.time",
    "partition.continue_above": "unseen_space.continuation holds for both edges of the view",
    "costs.floor": "the ground height now comes from the world or the drone, and costs.use_ground enables it",
    "partition.range_time": "the range follows from the look-ahead distance",
    "costs.blocked_range": "the path is checked as far as the look-ahead distance",
    "costs.blocked_radius": "the path is blocked where the clearance is below costs.distance_min",
    "vehicle.rate_z_lag": "vehicle.rate_lag holds for all body rates",
    "candidates.prove_stop": "stop_proof.prove_stop switches the stop proof",
}  # fmt: skip
"""Reason by the path of a removed parameter, whose value is ignored."""
