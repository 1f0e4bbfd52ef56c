"""Live ROS 2. Only this package imports rclpy, and only when a graph is joined: everything else works without ROS."""
