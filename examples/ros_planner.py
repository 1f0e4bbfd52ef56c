"""Write your own planner as a node of ROS 2, in any language: it knows AERO-Viz only by its topics.

It steers to the side on which the points leave more room, as `own_planner.py` does. Fly it, in two terminals:

    aero-viz sim forest --ros --speed 3
    python examples/ros_planner.py
"""

import contextlib
from collections import deque

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import PointCloud2

SPEED, RADIUS, REACH = 2.5, 0.8, 6.0  # [m/s], [m], [m]


class Sidestep(Node):
    """Reads /odometry, /points and /goal_pose, and publishes /command/velocity with every odometry."""

    def __init__(self) -> None:
        super().__init__("sidestep")
        self.clouds: deque[np.ndarray] = deque(maxlen=10)  # the last second, world frame
        self.goal: np.ndarray | None = None
        self.pose: tuple[np.ndarray, np.ndarray] | None = None
        self.command = self.create_publisher(TwistStamped, "/command/velocity", 1)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.create_subscription(PoseStamped, "/goal_pose", self.take_goal, latched)
        self.create_subscription(PointCloud2, "/points", self.take_points, qos_profile_sensor_data)
        self.create_subscription(Odometry, "/odometry", self.take_odometry, qos_profile_sensor_data)

    def take_goal(self, message: PoseStamped) -> None:
        position = message.pose.position
        self.goal = np.array([position.x, position.y, position.z])

    def take_points(self, message: PointCloud2) -> None:
        if self.pose is None:
            return
        rows = np.asarray(message.data, np.uint8).reshape(-1, message.point_step)
        position, rotation = self.pose
        self.clouds.append(rows[::4, :12].copy().view(np.float32) @ rotation.T + position)

    def take_odometry(self, message: Odometry) -> None:
        pose = message.pose.pose
        position, q = np.array([pose.position.x, pose.position.y, pose.position.z]), pose.orientation
        self.pose = position, rotation_of(q.w, q.x, q.y, q.z)
        if self.goal is not None and self.clouds:
            twist = TwistStamped()
            twist.header.stamp, twist.header.frame_id = message.header.stamp, "world"
            vector = twist.twist.linear
            vector.x, vector.y, vector.z = self.velocity(position, self.goal).tolist()
            self.command.publish(twist)

    def velocity(self, position: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Return the velocity along the cheapest of several straight paths [m/s]."""
        ahead = np.arctan2(*(goal - position)[1::-1])
        angles = ahead + np.radians(np.linspace(-80.0, 80.0, 33))
        directions = np.stack((np.cos(angles), np.sin(angles), np.zeros(33)), axis=1)
        points = np.concatenate(list(self.clouds)) - position
        points = points[(np.abs(points[:, 2]) < 1.0) & (np.hypot(*points[:, :2].T) < REACH)][::5]
        along = np.clip(points @ directions.T, 0.0, REACH)  # nearest place of each path to each point
        gaps = np.linalg.norm(points[:, None] - along[..., None] * directions, axis=2).min(axis=0, initial=RADIUS)
        cost = np.abs(angles - ahead) + 20.0 * (RADIUS - gaps)
        distance = np.linalg.norm(goal - position)
        climb = np.clip(goal[2] - position[2], -0.5, 0.5)
        return min(SPEED, distance) * directions[cost.argmin()] + np.array([0.0, 0.0, climb])


def rotation_of(w: float, x: float, y: float, z: float) -> np.ndarray:
    """Return the rotation matrix of a unit quaternion."""
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross


if __name__ == "__main__":
    rclpy.init()
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(Sidestep())
