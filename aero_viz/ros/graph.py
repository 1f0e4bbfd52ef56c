"""A node in the graph of ROS 2: its topics, subscriptions as reliable as their publishers, and publishers."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Collection
from types import ModuleType
from typing import Any, NamedTuple

from aero_planner.onboard import ros_node
from aero_viz.errors import UserError
from aero_viz.extras import how_to_install

SENSOR_TYPES = frozenset(
    {
        "sensor_msgs/msg/PointCloud2",
        "sensor_msgs/msg/LaserScan",
        "sensor_msgs/msg/Image",
        "sensor_msgs/msg/CameraInfo",
        "sensor_msgs/msg/Imu",
        "livox_ros_driver2/msg/CustomMsg",
        "livox_ros_driver/msg/CustomMsg",
    }
)
"""Types that are lost rather than repeated where any of their publishers does so."""

_DEPTH = 10


class Topic(NamedTuple):
    """A topic of the graph."""

    name: str
    types: tuple[str, ...]
    """More than one only where programs disagree."""
    publishers: int
    """Number of publishers, those of this node not included."""


class Quality(NamedTuple):
    """The parts of the quality of service in which publishers and subscriptions have to agree."""

    reliable: bool
    """True if lost messages are sent again."""
    latched: bool
    """True if a publisher keeps its last messages for subscriptions that come later ("transient local")."""


def import_rclpy() -> ModuleType:
    """Return rclpy: of a ROS 2 that was sourced, or of the wheels of the extra `ros`.

    Raises:
        UserError: there is no ROS 2; says how to install it.
    """
    try:
        return importlib.import_module("rclpy")
    except ImportError as error:
        raise UserError(
            f"Topics of ROS 2 {how_to_install('ros')} (x86-64, Python 3.11 to 3.13), or source an installed ROS 2 "
            f"(`source /opt/ros/jazzy/setup.bash`) and use its version of Python ({error})."
        ) from error


def message_class(type_name: str) -> Any:
    """Return the class of a type of messages, such as sensor_msgs/msg/PointCloud2.

    Raises:
        UserError: its package is not installed.
    """
    try:
        return ros_node.message_class(type_name)
    except ImportError as error:
        raise UserError(f"T{str(error)[1:]}, or name a topic of another type.") from error


class Graph:
    """A node with a context and a thread of its own, so that several live in one process and none touches signals.

    Callbacks run one at a time on the thread of the node. All methods may be called from any thread. Use it in a `with`
    statement, or call `close`.

    Args:
        name: name of the node.
        domain: number of the domain; None is that of ROS_DOMAIN_ID.
        parameters: True lets others list and set the node's parameters.

    Raises:
        UserError: there is no ROS 2, or it cannot start.
    """

    def __init__(self, name: str = "aero_viz", *, domain: int | None = None, parameters: bool = False) -> None:
        import_rclpy()
        try:
            self._context = ros_node.open_context(domain)
            self._node = ros_node.RosNode(self._context, name, parameters=parameters)
        except OSError as error:
            raise UserError(str(error)) from error
        self.node = self._node.node
        """The node of rclpy."""
        self.domain = self._context.get_domain_id()
        """Number of the domain."""
        self._node.start()

    def topics(self) -> list[Topic]:
        """Return the topics that somebody else publishes, by name."""
        found = ((name, types, self._publishers(name)) for name, types in self.node.get_topic_names_and_types())
        return sorted(Topic(name, tuple(types), len(infos)) for name, types, infos in found if infos)

    def nodes(self, topic: str) -> list[str]:
        """Return the names of the nodes that publish a topic."""
        infos = self._publishers(topic)
        return sorted(f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in infos)

    def types(self, topic: str) -> set[str]:
        """Return the types in which somebody else publishes a topic."""
        return {info.topic_type for info in self._publishers(topic)}

    def quality(self, topic: str, type_name: str) -> Quality | None:
        """Return what a subscription may ask for so that every publisher of a topic reaches it; None without any."""
        from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

        profiles = [info.qos_profile for info in self._publishers(topic) if info.topic_type == type_name]
        if not profiles:
            return None
        return Quality(
            all(profile.reliability == ReliabilityPolicy.RELIABLE for profile in profiles),
            all(profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for profile in profiles),
        )

    def subscribe(
        self, topic: str, type_name: str, callback: Callable[[Any], None], *, raw: bool = False, depth: int = _DEPTH
    ) -> Any:
        """Return a subscription that every publisher of a topic reaches.

        Where there is no publisher yet, that of sensor data is best effort and others are reliable. `quality` tells
        when publishers that come later need another subscription.

        Args:
            topic: name of the topic.
            type_name: type of its messages, such as nav_msgs/msg/Odometry.
            callback: called with every message on the thread of the node.
            raw: call it with the bytes of the message (CDR) instead.
            depth: number of messages that may wait.

        Raises:
            UserError: the type is not installed.
        """
        wanted = self.quality(topic, type_name) or Quality(type_name not in SENSOR_TYPES, False)
        kind = message_class(type_name)
        return self.node.create_subscription(kind, topic, callback, _profile(wanted, depth), raw=raw)

    def publisher(self, topic: str, type_name: str, *, latched: bool = False, depth: int = _DEPTH) -> Any:
        """Return a reliable publisher, which subscriptions of either kind receive.

        Raises:
            UserError: the type is not installed.
        """
        return self.node.create_publisher(message_class(type_name), topic, _profile(Quality(True, latched), depth))

    def remove(self, entity: Any) -> None:
        """Remove a subscription or a publisher."""
        from rclpy.publisher import Publisher

        if isinstance(entity, Publisher):
            self.node.destroy_publisher(entity)
        else:
            self.node.destroy_subscription(entity)

    def _publishers(self, topic: str) -> Collection[Any]:
        own = (self.node.get_name(), self.node.get_namespace())
        infos = self.node.get_publishers_info_by_topic(topic)
        return [info for info in infos if (info.node_name, info.node_namespace) != own]

    def close(self) -> None:
        """Leave the graph. May be called twice."""
        self._node.close()
        self._context.try_shutdown()

    def __enter__(self) -> Graph:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _profile(wanted: Quality, depth: int) -> Any:
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if wanted.reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if wanted.latched else DurabilityPolicy.VOLATILE,
    )
