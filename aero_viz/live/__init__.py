"""Live input: messages from ROS 2, a sensor or a file that is replayed, and the plans that are made from them now."""
