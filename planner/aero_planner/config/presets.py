"""Presets of the planner: named sets of changes to the default configuration."""

from __future__ import annotations

from aero_planner.parameters import Value

_PAPER: dict[str, Value] = {
    "stages.active": "",
    "vehicle.speed_limit": 50.0,
    "partition.fine_cells": 6,
    "partition.range_min": 0.0,
    "anchors.lookahead_time": 0.0,
    "candidates.previous": False,
    "candidates.safe_clearance": 0.25,
    "candidates.prefer_safe": False,
    "candidates.speed_margin": 0.0,
    "sampling.dt": 0.05,
    "sampling.samples": 128,
    "sampling.temperature": 0.1,
    "sampling.effective_samples": 0.0,
    "sampling.variance_thrust": 1.0,
    "sampling.correlation": 0.0,
    "costs.q_position": 3.0,
    "costs.q_track": 15.0,
    "costs.q_control": 0.5,
    "costs.q_thrust_jump": 0.0,
    "costs.q_speed": 0.0,
    "costs.distance_min": 0.4,
    "costs.distance_max": 1.0,
    "costs.penalty": 1e6,
    "costs.shape": "exponential",
    "costs.q_blocked": 0.0,
    "costs.use_ground": False,
}

_PX4: dict[str, Value] = {
    "vehicle.thrust_lag": 0.045,
    "vehicle.rate_lag": 0.07,
    "disturbance.disturbance_time": 0.0,
    "disturbance.drag_time": 0.0,
    "sampling.variance_rate_xy": 0.5,
    "sampling.variance_rate_z": 0.02,
    "costs.q_control_rate": 20.0,
    "costs.q_control_jump": 5.0,
}

_RACER: dict[str, Value] = {
    "vehicle.thrust_max": 40.0,
    "vehicle.rate_xy_max": 6.0,
    "vehicle.thrust_lag": 0.04,
    "vehicle.rate_lag": 0.03,
    "vehicle.speed_limit": 25.0,
    "candidates.speed_margin": 0.015,
    "sampling.steps": 50,
    "sampling.dt": 0.0225,
}

PRESETS: dict[str, tuple[str, dict[str, Value]]] = {
    "default": ("The best configuration known.", {}),
    "paper": ("The literal paper: every number and every formula.", _PAPER),
    "fast-cpu": (
        "The default with a quarter of the samples, for slow machines.",
        {"sampling.samples": 64, "sampling.effective_samples": 6.0},
    ),
    "racer": ("The default for a drone with a thrust-to-weight ratio of 4, at up to 25 m/s.", _RACER),
    "px4": ("The default with the lags of a drone with PX4, and smooth commands.", _PX4),
}
"""Description and changes of each preset by name."""
