"""Pose messages, decoded by rosbags from ROS 2 (CDR) and ROS 1 alike."""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

__all__ = ["POSE_TYPES", "TF_TYPES", "StampedPose", "decode_poses"]

POSE_TYPES = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
)
"""The preferred type first."""

TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")


class StampedPose(NamedTuple):
    """Pose of the frame `child` in the frame `parent`."""

    stamp: int
    """[ns], 0 where unset."""
    parent: str
    child: str
    """Empty where the message does not say."""
    values: tuple[float, ...]
    """Position [m], quaternion w, x, y, z, velocity in the child frame [m/s] (NaN where not recorded): ten numbers."""

    @property
    def valid(self) -> bool:
        """Whether the position is finite, the quaternion is one (unset ones are all zero) and the names are names."""
        position, quaternion = self.values[:3], self.values[3:7]
        norm = math.hypot(*quaternion)
        named = (self.parent + self.child).isprintable()
        return named and all(map(math.isfinite, position)) and 0.5 < norm < 2.0 and max(map(abs, position)) < 1e8


@cache
def _typestore(encoding: str):
    # These types have had one definition in every distribution, so the bag's own ones are not needed.
    if encoding != "ros1":
        return get_typestore(Stores.ROS2_HUMBLE)
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF_TYPES[0]))
    return store


def decode_poses(data: bytes, kind: str, encoding: str) -> list[StampedPose]:
    """Return the poses in one message of `POSE_TYPES` or `TF_TYPES`; raises ValueError when it is damaged."""
    kind = TF_TYPES[0] if kind in TF_TYPES else kind
    try:
        store = _typestore(encoding)
        message: Any = (store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr)(data, kind)
    except Exception as error:  # generated code fails in as many ways as bytes can be wrong
        raise ValueError(f"a {kind} message is damaged ({error})") from error
    if kind in TF_TYPES:
        return [_transform(item) for item in message.transforms]
    if kind.endswith("TransformStamped"):
        return [_transform(message)]
    if kind.endswith("/Odometry"):
        twist = message.twist.twist.linear
        return [_pose(message, message.pose.pose, message.child_frame_id, (twist.x, twist.y, twist.z))]
    return [_pose(message, getattr(message.pose, "pose", message.pose), "", None)]


def _pose(message: Any, pose: Any, child: str, velocity: tuple[float, float, float] | None) -> StampedPose:
    return _stamped(message.header, child, pose.position, pose.orientation, velocity)


def _transform(message: Any) -> StampedPose:
    return _stamped(
        message.header, message.child_frame_id, message.transform.translation, message.transform.rotation, None
    )


def _stamped(header: Any, child: str, p: Any, q: Any, velocity: tuple[float, float, float] | None) -> StampedPose:
    stamp = header.stamp.sec * 10**9 + header.stamp.nanosec
    values = (p.x, p.y, p.z, q.w, q.x, q.y, q.z, *(velocity or (math.nan,) * 3))
    return StampedPose(stamp, header.frame_id.lstrip("/"), child.lstrip("/"), values)
