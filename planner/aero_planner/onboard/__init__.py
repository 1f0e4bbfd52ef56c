"""The node that flies: it connects a LiDAR, the planner and an autopilot. docs/onboard.md describes it.

- The loop: `node`, `interfaces` (to LiDAR, autopilot and observers), `periodic_loop`, `replanner`, `plan_schedule`,
  `command_choice`, `braking_path`, `stop_controller`, `dead_reckoning`, `drift_correction`, `goal_tracker`.
- Safety: `failsafe_table` (what happens on which fault), `failsafe_conditions` (which faults there are now),
  `safety_machine`, `watchdog`, `failsafe_process`, `heartbeat_memory`, `readiness_log`, `safety_docs`.
- LiDAR: `livox`, `sweep_buffer`, `host_clock`.
- ROS 2, where the settings ask for it: `ros`, `ros_points`, `odometry`.
- Measured by the LiDAR: the ground height (`ground_tracker`, `ground_plane`), and how far the autopilot's estimate
  drifts (`drift_monitor`, `cloud_drift`).
- Autopilot: `mavlink`, `mavlink_state`, `mavlink_sender`, `mavlink_parser`, `mavlink_signing`, `transport`,
  `datagram_filter`, `round_trips`, `frames`, `thrust`, `thrust_estimate`, `estimator_reset`.
- Observers: `flight_log`, `ros_messages`, `telemetry`, `telemetry_protocol`, `stderr`.
- Programs: `run`, `preflight`, `input_checks`, `px4_parameters`, `bundle_export`, `connections`, `settings`,
  `agreement`, `flight_config`, `lag_identification`.
"""
