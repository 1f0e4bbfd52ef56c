"""A LiDAR and an odometry in a corridor, as drivers publish them: python -m tests.ros.driver [options].

The body moves forward and back along the corridor, 4 m each way. On stdin, it takes lines: a name of garbage (see
`GARBAGE`) publishes one such cloud.
"""

from __future__ import annotations

import argparse
import array
import contextlib
import sys
import threading
import time

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.qos import QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from sensor_msgs.msg import PointCloud2, PointField

LENGTH, WIDTH, HEIGHT = 40.0, 6.0, 5.0
"""Size of the corridor [m]; the body is in its middle."""
GARBAGE = ("nan", "wrong_step", "future", "empty")
SPEED, SPAN = 1.0, 4.0


def corridor(count: int, seed: int = 0) -> NDArray[np.float32]:
    """Return points on the walls, the floor and pillars of a corridor [m], [count, 3], world frame."""
    random = np.random.default_rng(seed)
    places = random.uniform((-LENGTH / 2, -WIDTH / 2, 0.0), (LENGTH / 2, WIDTH / 2, HEIGHT), (count, 3))
    side = random.integers(0, 4, count)
    places[side == 0, 1], places[side == 1, 1] = -WIDTH / 2, WIDTH / 2
    places[side == 2, 2] = 0.0
    pillars = side == 3
    angle = random.uniform(0.0, 2.0 * np.pi, pillars.sum())
    places[pillars, 0] = 5.0 * random.integers(-4, 5, pillars.sum()) + 2.5 + 0.3 * np.cos(angle)
    places[pillars, 1] = 1.8 * random.choice([-1.0, 1.0], pillars.sum()) + 0.3 * np.sin(angle)
    return places.astype(np.float32)


def position(seconds: float) -> NDArray[np.float64]:
    """Return the place of the body at a time [m], [3]."""
    phase = (SPEED * seconds) % (2.0 * SPAN)
    return np.array([min(phase, 2.0 * SPAN - phase), 0.0, 1.5])


def stamp_of(nanoseconds: int) -> Time:
    return Time(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)


def cloud_message(points: NDArray[np.float32], stamp: int, frame: str = "lidar") -> PointCloud2:
    """Return points [m], [P, 3], as a message."""
    message = PointCloud2(height=1, width=len(points), point_step=16, row_step=16 * len(points), is_dense=True)
    message.header.frame_id, message.header.stamp = frame, stamp_of(stamp)
    message.fields = [PointField(name=n, offset=4 * i, datatype=7, count=1) for i, n in enumerate("xyz")]
    rows = np.zeros((len(points), 4), np.float32)
    rows[:, :3] = points
    message.data = array.array("B", rows.tobytes())
    return message


def odometry_message(place: NDArray[np.float64], stamp: int, speed: float, body: str = "lidar") -> Odometry:
    message = Odometry(child_frame_id=body)
    message.header.frame_id, message.header.stamp = "odom", stamp_of(stamp)
    message.pose.pose.position.x, message.pose.pose.position.y, message.pose.pose.position.z = map(float, place)
    message.pose.pose.orientation.w = 1.0
    message.twist.twist.linear.x = speed
    return message


def garbage(kind: str, points: NDArray[np.float32], stamp: int) -> PointCloud2:
    """Return a cloud that cannot be used."""
    if kind == "nan":
        return cloud_message(np.full_like(points, np.nan), stamp)
    if kind == "empty":
        return cloud_message(points[:0], stamp)
    message = cloud_message(points, stamp + 3_600_000_000_000 if kind == "future" else stamp)
    if kind == "wrong_step":
        message.point_step = 1000
    return message


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--points", type=int, default=4000)
    parser.add_argument("--rate", type=float, default=10.0)
    parser.add_argument("--odometry-rate", type=float, default=50.0)
    parser.add_argument("--cloud-topic", default="/points")
    parser.add_argument("--odometry-topic", default="/odometry")
    parser.add_argument("--best-effort", action="store_true")
    parser.add_argument("--no-odometry", action="store_true")
    parser.add_argument("--in-world", action="store_true", help="publish the cloud in the frame of the odometry")
    parser.add_argument("--clouds", type=int, default=10**9, help="publish so many, and end")
    parser.add_argument("--wait", action="store_true", help="begin when both topics are subscribed to")
    parser.add_argument("--node", default="driver")
    options = parser.parse_args()
    rclpy.init()
    with contextlib.suppress(RuntimeError):  # by SIGTERM
        publish(options)


def publish(options: argparse.Namespace) -> None:
    node = rclpy.create_node(options.node)
    reliable = QoSProfile(depth=20, reliability=ReliabilityPolicy.RELIABLE)
    quality = qos_profile_sensor_data if options.best_effort else reliable
    clouds = node.create_publisher(PointCloud2, options.cloud_topic, quality)
    poses = None if options.no_odometry else node.create_publisher(Odometry, options.odometry_topic, quality)
    print("ready", flush=True)
    while options.wait and rclpy.ok() and not all(p.get_subscription_count() for p in (clouds, poses) if p is not None):
        time.sleep(0.01)
    world, began, sent = corridor(options.points), time.monotonic(), 0
    orders: list[str] = []
    threading.Thread(target=lambda: orders.extend(line.strip() for line in sys.stdin), daemon=True).start()
    step, ticks, next_cloud = 1.0 / options.odometry_rate, 0, 0.0
    while rclpy.ok() and sent < options.clouds:
        seconds, stamp = ticks * step, time.time_ns()
        place = position(seconds)
        if poses is not None:
            forward = SPEED if (SPEED * seconds) % (2.0 * SPAN) < SPAN else -SPEED
            poses.publish(odometry_message(place, stamp, forward))
        if seconds >= next_cloud - 1e-9:
            next_cloud += 1.0 / options.rate
            points = world if options.in_world else world - place.astype(np.float32)
            clouds.publish(cloud_message(points, stamp, "odom" if options.in_world else "lidar"))
            sent += 1
        while orders:
            clouds.publish(garbage(orders.pop(0), world, time.time_ns()))
        ticks += 1
        time.sleep(max(began + ticks * step - time.monotonic(), 0.0))
    time.sleep(0.5)  # what is on its way arrives


if __name__ == "__main__":
    main()
