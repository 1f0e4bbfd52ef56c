"""Messages that hold poses: odometry, stamped poses and transforms."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from aero_viz.input_limits import NAME_MAX
from aero_viz.recordings.poses import SPEED_MAX
from aero_viz.recordings.ros_messages import TF_TYPES, decode_message

if TYPE_CHECKING:
    from rosbags.typesys.stores.ros2_humble import (
        geometry_msgs__msg__Point,
        geometry_msgs__msg__PoseStamped,
        geometry_msgs__msg__PoseWithCovarianceStamped,
        geometry_msgs__msg__Quaternion,
        geometry_msgs__msg__TransformStamped,
        geometry_msgs__msg__Vector3,
        nav_msgs__msg__Odometry,
        std_msgs__msg__Header,
        tf2_msgs__msg__TFMessage,
    )

TRANSFORM_STAMPED = "geometry_msgs/msg/TransformStamped"

POSE_TYPES = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    TRANSFORM_STAMPED,
)
"""The preferred type first."""

_MAX_COORDINATE = 1e8
"""A larger coordinate [m] is damaged."""


class StampedPose(NamedTuple):
    """Pose of the frame `child` in the frame `parent`."""

    stamp: int
    """[ns], 0 where unset."""
    parent: str
    child: str
    """Empty where the message does not say."""
    values: tuple[float, ...]
    """Position [m], quaternion (w, x, y, z), velocity in the child frame [m/s] (NaN if not recorded): ten numbers."""

    @property
    def defect(self) -> str:
        """Reason why the pose cannot be used, empty if it can; completes "The pose cannot be used because ..."."""
        position, quaternion, velocity = self.values[:3], self.values[3:7], self.values[7:]
        names = self.parent + self.child
        if len(names) > NAME_MAX or not names.isprintable():
            return "a name in it is damaged"
        if not all(abs(value) < _MAX_COORDINATE for value in position):  # NaN compares false
            return "its position is not valid"
        if not 0.5 < math.hypot(*quaternion) < 2.0:  # unset quaternions are all zero
            return "its quaternion is not valid"
        if any(abs(value) > SPEED_MAX for value in velocity):  # NaN is a velocity that was not recorded
            return f"its velocity is beyond {SPEED_MAX:g} m/s"
        return ""


def decode_poses(data: bytes, type_name: str, encoding: str) -> list[StampedPose]:
    """Return the poses in a message of one of `POSE_TYPES` or `TF_TYPES`.

    Raises:
        DamagedMessage: the message is damaged.
    """
    message = decode_message(data, type_name, encoding)
    if type_name in TF_TYPES:
        tf: tf2_msgs__msg__TFMessage = message
        return [_from_transform(transform) for transform in tf.transforms]
    if type_name == TRANSFORM_STAMPED:
        return [_from_transform(message)]
    if type_name == POSE_TYPES[0]:
        odometry: nav_msgs__msg__Odometry = message
        pose, twist = odometry.pose.pose, odometry.twist.twist.linear
        velocity = (twist.x, twist.y, twist.z)
        return [_stamped_pose(odometry.header, odometry.child_frame_id, pose.position, pose.orientation, velocity)]
    if type_name == POSE_TYPES[1]:
        stamped: geometry_msgs__msg__PoseStamped = message
        return [_stamped_pose(stamped.header, "", stamped.pose.position, stamped.pose.orientation)]
    uncertain: geometry_msgs__msg__PoseWithCovarianceStamped = message
    return [_stamped_pose(uncertain.header, "", uncertain.pose.pose.position, uncertain.pose.pose.orientation)]


def _from_transform(message: geometry_msgs__msg__TransformStamped) -> StampedPose:
    transform = message.transform
    return _stamped_pose(message.header, message.child_frame_id, transform.translation, transform.rotation)


def _stamped_pose(
    header: std_msgs__msg__Header,
    child: str,
    p: geometry_msgs__msg__Point | geometry_msgs__msg__Vector3,
    q: geometry_msgs__msg__Quaternion,
    velocity: tuple[float, float, float] = (math.nan, math.nan, math.nan),
) -> StampedPose:
    stamp = header.stamp.sec * 10**9 + header.stamp.nanosec
    values = (p.x, p.y, p.z, q.w, q.x, q.y, q.z, *velocity)
    return StampedPose(stamp, header.frame_id.lstrip("/"), child.lstrip("/"), values)
