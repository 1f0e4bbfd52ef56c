"""Presets of the planner: named sets of changes to the default configuration."""

from __future__ import annotations

from aero_planner.config.parameter import Value

_PAPER: dict[str, Value] = {
    "vehicle.speed_limit": 50.0,
    "vehicle.disturbance_time": 0.0,
    "partition.range_min": 0.0,
    "anchors.lookahead_rest": 5.0,
    "partition.range_time": 0.0,
    "partition.continue_below": 0.0,
    "partition.continue_above": 0.0,
    "partition.predict": False,
    "anchors.lookahead_time": 0.0,
    "anchors.slow_spread": 1.0,
    "anchors.slow_rise": 1.0,
    "anchors.slow_cycle": 1,
    "candidates.previous": False,
    "candidates.brake": False,
    "candidates.safe_clearance": 0.25,
    "candidates.prefer_safe": False,
    "candidates.prove_stop": "off",
    "candidates.speed_margin": 0.0,
    "candidates.between_steps": False,
    "candidates.brake_fan": 0.0,
    "sampling.temperature": 0.1,
    "sampling.correlation": 0.0,
    "sampling.keep_nominal": False,
    "sampling.fresh_noise": False,
    "costs.q_position": 3.0,
    "costs.q_track": 15.0,
    "costs.q_control": 0.5,
    "costs.q_speed": 0.0,
    "costs.distance_min": 0.4,
    "costs.distance_max": 1.0,
    "costs.penalty": 1e6,
    "costs.shape": "exponential",
    "costs.q_blocked": 0.0,
    "costs.waypoint_distance": 0.0,
    "escape.q_escape": 0.0,
    "costs.use_ground": False,
}

_PX4: dict[str, Value] = {
    "vehicle.thrust_lag": 0.045,
    "vehicle.disturbance_time": 0.0,
    "vehicle.rate_xy_lag": 0.07,
    "vehicle.rate_z_lag": 0.07,
    "sampling.variance_rate_z": 0.02,
    "sampling.nominal_lag": 0.1,
    "costs.q_control_rate": 100.0,
    "costs.q_control_jump": 60.0,
    "costs.q_height": 3.0,
    # As in the flights with PX4 of docs/onboard.md: defaults of that time.
    "partition.continue_before": 1.0,
    "candidates.stop_clearance": 0.3,
    "sampling.temperature": 0.1,
    "costs.q_position": 3.0,
    "costs.q_control": 0.5,
    "costs.q_speed": 10.0,
    "costs.soft_weight": 100.0,
    "costs.blocked_radius": 0.35,
}

PRESETS: dict[str, tuple[str, dict[str, Value]]] = {
    "default": ("The best configuration known.", {}),
    "paper": ("The literal paper: every number and every formula.", _PAPER),
    "fast-cpu": ("The default with a quarter of the samples, for slow machines.", {"sampling.samples": 32}),
    "px4": ("The default with the lags of a drone with PX4, and smooth commands.", _PX4),
}
"""Description and changes of each preset by name."""
