"""Points and the vehicle's state from topics of ROS 2. The one module of the node that imports rclpy, when it is used.

Messages wait in bounded queues until the control loop takes them, so that nothing of ROS runs in that loop. Nothing is
published: commands go to the autopilot over MAVLink alone.
"""

from __future__ import annotations

import importlib
import logging
import threading
import time
from collections.abc import Callable
from typing import Any

from aero_planner.onboard.host_clock import HostClock
from aero_planner.onboard.odometry import RosOdometry
from aero_planner.onboard.ros_points import RosPoints
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.sweep_buffer import lidar_mount

_log = logging.getLogger(__name__)

_SEARCH_PERIOD = 0.5  # [s] between two looks for the type of a topic
_CLOSE_TIMEOUT = 5.0  # [s]
_CLOUDS = {"sensor_msgs/msg/PointCloud2": False, "livox_ros_driver2/msg/CustomMsg": True}
"""Types of clouds, and whether their bytes are decoded here, since rclpy takes too long for them."""


class RosInputs:
    """A node of ROS 2 that subscribes to the topics which the settings name.

    Args:
        config: Settings of the node.
        clock: Host time [s].

    Raises:
        ImportError: There is no ROS 2; says what to do.
        OSError: It cannot start.

    Attributes:
        points: The LiDAR; None if it is not read from ROS.
        odometry: Where the vehicle is; None if the autopilot tells.
    """

    def __init__(self, config: OnboardConfig, *, clock: Callable[[], float] = time.monotonic) -> None:
        try:
            rclpy = importlib.import_module("rclpy")
            from rclpy.executors import SingleThreadedExecutor
            from rclpy.node import Node
            from rclpy.signals import SignalHandlerOptions
        except ImportError as error:
            raise ImportError(
                f"lidar.source or state.source is ros, and rclpy can't be imported ({error}); source ROS 2 "
                "(source /opt/ros/humble/setup.bash) and start the node with its version of Python."
            ) from error
        # Stamps of all topics are of the same clock. The odometry is computed from the points, so its own delay is
        # never zero: only with the offset that the points show does it fit to them.
        stamps = HostClock()
        lidar, state = config.lidar, config.state
        self.points = RosPoints(stamps, clock, lidar.keep_uncertain) if lidar.source == "ros" else None
        self.odometry = RosOdometry(state, lidar_mount(config), stamps, clock) if state.source == "ros" else None
        self._context = rclpy.Context()
        try:
            rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
            self._node = Node("aero_planner", context=self._context, start_parameter_services=False)
        except Exception as error:  # rclpy raises several unrelated classes
            self._context.try_shutdown()
            raise OSError(f"ROS 2 can't start: {error}; check ROS_DOMAIN_ID.") from error
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        if self.odometry is not None:
            self._subscribe(state.topic, "nav_msgs/msg/Odometry", self.odometry.receive)
        self._searched = lidar.topic if self.points is not None else None
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="ros", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        searched = -float("inf")
        while not self._closed.is_set():
            if self._searched is not None and time.monotonic() - searched > _SEARCH_PERIOD:
                searched = time.monotonic()
                self._find_points(self._searched)
            self._executor.spin_once(timeout_sec=_SEARCH_PERIOD)

    def _find_points(self, topic: str) -> None:
        """Subscribe to the topic of the points once somebody publishes it, with the type that it has."""
        assert self.points is not None
        for info in self._node.get_publishers_info_by_topic(topic):
            if info.topic_type in _CLOUDS:
                is_raw = _CLOUDS[info.topic_type]
                self._subscribe(
                    topic, info.topic_type, self.points.receive_custom if is_raw else self.points.receive, raw=is_raw
                )
            else:
                _log.error("%s has messages of the type %s, which hold no points", topic, info.topic_type)
            self._searched = None
            return

    def _subscribe(self, topic: str, kind: str, receive: Callable[[Any], None], *, raw: bool = False) -> None:
        from rclpy.qos import qos_profile_sensor_data

        package, _, name = kind.partition("/msg/")
        try:
            message = getattr(importlib.import_module(f"{package}.msg"), name)
        except (ImportError, AttributeError) as error:
            _log.error("%s can't be read: %s; source the workspace that has %s", topic, error, package)
            return
        self._node.create_subscription(message, topic, receive, qos_profile_sensor_data, raw=raw)

    def close(self) -> None:
        """Leave the graph."""
        self._closed.set()
        self._executor.wake()
        self._thread.join(_CLOSE_TIMEOUT)
        self._executor.shutdown(0.0)
        self._node.destroy_node()
        self._context.try_shutdown()
