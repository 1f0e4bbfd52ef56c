"""Points, state and parameters from ROS 2. Imports rclpy when it is used.

Messages wait in bounded queues until the control loop takes them, so that nothing of ROS runs in that loop. No topic of
the node is published: commands go to the autopilot over MAVLink alone.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from aero_planner.config import ParameterInfo, Value
from aero_planner.onboard.host_clock import HostClock
from aero_planner.onboard.odometry import RosOdometry
from aero_planner.onboard.ros_node import RosNode, message_class, open_context
from aero_planner.onboard.ros_points import RosPoints
from aero_planner.onboard.ros_tuning import RosTuning
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.sweep_buffer import lidar_mount

_log = logging.getLogger(__name__)

_SEARCH_PERIOD = 0.5  # [s] between two looks for the type of a topic
_FOLLOW_PERIOD = 0.1  # [s] after which a value that has changed is one of the node's parameters, too
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
            self._context = open_context()
        except ImportError as error:
            raise ImportError(
                f"lidar.source or state.source is ros, and rclpy can't be imported ({error}); source ROS 2 "
                "(source /opt/ros/humble/setup.bash) and start the node with its version of Python."
            ) from error
        # Stamps of all topics are of the same clock. The odometry is computed from the points, so its own delay is
        # never zero: only with the offset that the points show does it fit to them. Without, the date shows it.
        stamps = HostClock()
        lidar, state = config.lidar, config.state
        self.points = RosPoints(stamps, clock, lidar.keep_uncertain) if lidar.source == "ros" else None
        date = time.time if self.points is None else None
        is_wanted = state.source == "ros"
        self.odometry = RosOdometry(state, lidar_mount(config), stamps, clock, date=date) if is_wanted else None
        self._inputs = RosNode(self._context, "aero_planner")
        self._nodes = [self._inputs]
        if self.odometry is not None:
            self._subscribe(state.topic, "nav_msgs/msg/Odometry", self.odometry.receive)
        self._searched = lidar.topic if self.points is not None else None
        self._next_search = -float("inf")
        self._refused: set[str] = set()
        self._inputs.start(self._search)

    def offer(self, tuning: RosTuning) -> None:
        """Let others set the parameters that may change in flight, as those of the node /aero_planner/tuning.

        The node has a thread of its own, since whoever sets a parameter waits for the next plan: no message does.
        """
        node = RosNode(self._context, "tuning", namespace="aero_planner", parameters=True)
        NodeParameters(node.node, tuning.current, tuning.ask)
        node.start()
        self._nodes.append(node)

    def _search(self) -> None:
        if self._searched is not None and time.monotonic() >= self._next_search:
            self._next_search = time.monotonic() + _SEARCH_PERIOD
            self._find_points(self._searched)

    def _find_points(self, topic: str) -> None:
        """Subscribe to the topic of the points once somebody publishes it, with the type that it has."""
        assert self.points is not None
        for info in self._inputs.node.get_publishers_info_by_topic(topic):
            if (kind := info.topic_type) in _CLOUDS:
                is_raw = _CLOUDS[kind]
                receive = self.points.receive_custom if is_raw else self.points.receive
                self._subscribe(topic, kind, receive, raw=is_raw)
                self._searched = None
                return
            if kind not in self._refused:
                self._refused.add(kind)
                _log.error("%s has messages of the type %s, which hold no points", topic, kind)

    def _subscribe(self, topic: str, kind: str, receive: Callable[[Any], None], *, raw: bool = False) -> None:
        from rclpy.qos import qos_profile_sensor_data

        try:
            message = message_class(kind)
        except ImportError as error:
            _log.error("%s can't be read: %s", topic, error)
            return
        self._inputs.node.create_subscription(message, topic, receive, qos_profile_sensor_data, raw=raw)

    def close(self) -> None:
        """Leave the graph."""
        for node in self._nodes:
            node.close()
        self._context.try_shutdown()


class NodeParameters:
    """Declares parameters of a node, such as "costs.q_track", lets others set them, and keeps both sides equal.

    Everything happens on the thread of the node, so that nothing is set by two threads at once.

    Args:
        node: the node of rclpy, with parameter services.
        current: returns the parameters and their values in force by path. If it returns others, those are declared.
        ask: changes values, by path; raises ValueError with the reason if that is refused.
    """

    def __init__(
        self,
        node: Any,
        current: Callable[[], tuple[Sequence[ParameterInfo], Mapping[str, Value]]],
        ask: Callable[[Mapping[str, Any]], None],
    ) -> None:
        # Humble has no rclpy.clock_type.
        from rclpy.clock import Clock, ClockType  # pyright: ignore[reportPrivateImportUsage]

        self._node, self._current, self._ask = node, current, ask
        self._declared: dict[str, ParameterInfo] = {}
        self._is_own = False
        """True while the node's parameters are set from here."""
        self._follow()
        node.add_on_set_parameters_callback(self._take)
        node.create_timer(_FOLLOW_PERIOD, self._follow, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _take(self, parameters: list[Any]) -> Any:
        from rcl_interfaces.msg import SetParametersResult

        changes = {parameter.name: parameter.value for parameter in parameters if parameter.name in self._declared}
        try:
            if changes and not self._is_own:
                self._ask(changes)
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _follow(self) -> None:
        """Make the node's parameters those in force."""
        from rclpy.parameter import Parameter

        infos, values = self._current()
        self._is_own = True
        try:
            if list(infos) != list(self._declared.values()):
                self._declare(infos, values)
            # An integer that was set for a float is equal, but of another type.
            changed = [
                Parameter(path, value=value)
                for path, value in values.items()
                if (old := self._node.get_parameter(path).value) != value or type(old) is not type(value)
            ]
            if changed:
                self._node.set_parameters(changed)
        finally:
            self._is_own = False

    def _declare(self, infos: Sequence[ParameterInfo], values: Mapping[str, Value]) -> None:
        for path in self._declared:
            self._node.undeclare_parameter(path)
        self._declared = {info.path: info for info in infos}
        self._node.declare_parameters("", [(info.path, values[info.path], _descriptor(info)) for info in infos])


def _descriptor(info: ParameterInfo) -> Any:
    from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

    descriptor = ParameterDescriptor(
        name=info.path,
        description=f"{info.title}: {info.help}",
        additional_constraints=info.range,
        # Otherwise 8 for 8.0 would be refused, with the numbers of the types as the reason.
        dynamic_typing=True,
    )
    if isinstance(info.default, float):
        descriptor.floating_point_range = [FloatingPointRange(from_value=info.low, to_value=info.high)]
    elif info.is_number:
        descriptor.integer_range = [IntegerRange(from_value=int(info.low), to_value=int(info.high), step=1)]
    return descriptor
