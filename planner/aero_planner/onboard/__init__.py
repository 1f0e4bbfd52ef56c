"""The node that flies: it connects a LiDAR, the planner and an autopilot. docs/onboard.md describes it.

- The loop: `node`, `interfaces` (to LiDAR, autopilot and observers), `periodic_loop`, `replanner`, `plan_schedule`,
  `dead_reckoning`, `goal_tracker`, `stop_controller`.
- Safety: `failsafe_table` (what happens on which fault), `safety_machine`, `watchdog`, `failsafe_process`,
  `readiness_log`,
  `safety_docs`.
- LiDAR: `livox`, `sweep_buffer`, `host_clock`.
- Height above ground: `ground_tracker`, `ground_plane`.
- Autopilot: `mavlink`, `mavlink_parser`, `mavlink_signing`, `transport`, `datagram_filter`, `frames`, `thrust`,
  `estimator_reset`.
- Observers: `flight_log`, `ros_messages`, `telemetry`, `telemetry_protocol`, `stderr`.
- Programs: `run`, `preflight`, `input_checks`, `px4_parameters`, `bundle_export`, `connections`, `settings`.
"""
