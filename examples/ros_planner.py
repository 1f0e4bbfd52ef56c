"""Steer to where there is room, as a node of ROS 2: start `aero-viz sim forest --ros --speed 3`, and this beside it."""

import contextlib
from collections import deque

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2

SPEED, RADIUS, REACH = 2.5, 0.8, 6.0  # [m/s], [m], [m]
ANGLES = np.radians(np.linspace(-80.0, 80.0, 33))


class Sidestep(Node):
    def __init__(self) -> None:
        super().__init__("sidestep")
        self.clouds: deque[np.ndarray] = deque(maxlen=10)  # the last second, world frame [m]
        self.goal, self.position, self.rotation = None, np.zeros(3), np.eye(3)
        self.command = self.create_publisher(TwistStamped, "/command/velocity", 1)
        self.create_subscription(PoseStamped, "/goal_pose", self.take_goal, 1)
        self.create_subscription(PointCloud2, "/points", self.take_points, qos_profile_sensor_data)
        self.create_subscription(Odometry, "/odometry", self.take_odometry, qos_profile_sensor_data)

    def take_goal(self, message: PoseStamped) -> None:
        self.goal = np.array([getattr(message.pose.position, axis) for axis in "xyz"])

    def take_points(self, message: PointCloud2) -> None:
        rows = np.asarray(message.data, np.uint8).reshape(-1, message.point_step)[::4, :12]
        self.clouds.append(rows.copy().view(np.float32) @ self.rotation.T + self.position)

    def take_odometry(self, message: Odometry) -> None:
        self.position = np.array([getattr(message.pose.pose.position, axis) for axis in "xyz"])
        quaternion = [getattr(message.pose.pose.orientation, axis) for axis in "xyzw"]
        self.rotation = Rotation.from_quat(quaternion).as_matrix()
        if self.goal is not None and self.clouds:
            twist, linear = TwistStamped(header=message.header), self.velocity(self.goal - self.position)
            twist.twist.linear.x, twist.twist.linear.y, twist.twist.linear.z = linear.tolist()
            self.command.publish(twist)

    def velocity(self, to_goal: np.ndarray) -> np.ndarray:
        ahead = ANGLES + np.arctan2(to_goal[1], to_goal[0])
        ways = np.stack((np.cos(ahead), np.sin(ahead), 0.0 * ahead), axis=1)
        points = np.concatenate(list(self.clouds)) - self.position
        points = points[(np.abs(points[:, 2]) < 1.0) & (np.hypot(*points[:, :2].T) < REACH)][::5]
        nearest = np.clip(points @ ways.T, 0.0, REACH)[..., None] * ways  # on each way, to each point
        gaps = np.linalg.norm(points[:, None] - nearest, axis=2).min(axis=0, initial=RADIUS)
        way = ways[(np.abs(ANGLES) + 20.0 * (RADIUS - gaps)).argmin()]
        return min(SPEED, float(np.linalg.norm(to_goal))) * way + np.clip([0.0, 0.0, to_goal[2]], -0.5, 0.5)


rclpy.init()
with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
    rclpy.spin(Sidestep())
