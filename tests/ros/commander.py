"""Commands the simulated drone to the goal with one type of message: python -m tests.ros.commander TYPE [SECONDS]

It publishes with every odometry, for SECONDS of them at most. Nothing is in the way.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from geometry_msgs.msg import Transform, Twist

from aero_planner.quaternions import conjugate, rotate
from aero_viz.ros.commands import TOPICS
from aero_viz.ros.graph import Graph, message_class

SPEED = 2.0


def main(kind: str, seconds: float = np.inf) -> None:
    topic = next(name for name, its in TOPICS.items() if its == kind)
    goal: list[Any] = []
    first: list[float] = []

    def take(odometry: Any) -> None:
        now = odometry.header.stamp.sec + 1e-9 * odometry.header.stamp.nanosec
        first[:] = first or [now]
        if not goal or now - first[0] > seconds:
            return
        pose, q = odometry.pose.pose.position, odometry.pose.pose.orientation
        position, attitude = np.array([pose.x, pose.y, pose.z]), (q.w, q.x, q.y, q.z)
        to_goal = np.array([goal[0].x, goal[0].y, goal[0].z]) - position
        velocity = SPEED * to_goal / max(float(np.linalg.norm(to_goal)), 1.0)
        linear = odometry.twist.twist.linear
        own = rotate(attitude, (linear.x, linear.y, linear.z))
        publisher.publish(message_of(kind, odometry, position, to_goal, velocity, own, attitude))

    with Graph("commander") as graph:
        publisher = graph.publisher(topic, kind)
        graph.subscribe("/odometry", "nav_msgs/msg/Odometry", take)
        graph.subscribe("/goal_pose", "geometry_msgs/msg/PoseStamped", lambda m: goal.append(m.pose.position))
        print("ready", flush=True)
        sys.stdin.read()


def message_of(kind: str, odometry: Any, position: Any, to_goal: Any, velocity: Any, own: Any, attitude: Any) -> Any:
    """Return the command that flies to the goal."""
    from geometry_msgs.msg import PoseStamped
    from trajectory_msgs.msg import MultiDOFJointTrajectoryPoint

    message = message_class(kind)()
    if kind == "geometry_msgs/msg/Twist":  # the drone does not turn, and flies with little tilt
        set_vector(message.linear, rotate(conjugate(attitude), velocity) * (1.0, 1.0, 0.0))
        return message
    message.header.stamp, message.header.frame_id = odometry.header.stamp, "world"
    if kind == "geometry_msgs/msg/TwistStamped":
        set_vector(message.twist.linear, velocity)
    elif kind == "geometry_msgs/msg/AccelStamped":
        set_vector(message.accel.linear, 2.0 * (velocity - own))
    elif kind == "nav_msgs/msg/Path":
        for share in (0.0, 0.5, 1.0):
            pose = PoseStamped()
            set_vector(pose.pose.position, position + share * to_goal)
            message.poses.append(pose)
    elif kind == "trajectory_msgs/msg/MultiDOFJointTrajectory":
        for time in (0.0, 0.5, 1.0):
            place, twist = Transform(), Twist()
            point = MultiDOFJointTrajectoryPoint(transforms=[place], velocities=[twist])
            set_vector(place.translation, position + time * velocity)
            set_vector(twist.linear, velocity)
            point.time_from_start.sec, point.time_from_start.nanosec = int(time), round(1e9 * (time % 1.0))
            message.points.append(point)
    return message


def set_vector(vector: Any, values: Any) -> None:
    vector.x, vector.y, vector.z = (float(value) for value in values)


if __name__ == "__main__":
    main(sys.argv[1], *map(float, sys.argv[2:]))
