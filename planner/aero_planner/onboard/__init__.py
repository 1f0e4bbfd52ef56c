"""What runs on the drone: transports, safety and the node around the planner. MAVLink is an extra."""
