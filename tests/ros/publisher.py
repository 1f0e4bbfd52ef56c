"""Publishes text on topics until it is ended: python -m tests.ros.publisher TOPIC=QUALITY ..

A quality is "reliable", "best_effort" or "latched". The texts are the topic's name and a number that counts up, ten a
second.
"""

from __future__ import annotations

import sys
import time

import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

QUALITIES = {
    "reliable": QoSProfile(depth=10),
    "best_effort": QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT),
    "latched": QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL),
}


def main() -> None:
    rclpy.init()
    node = rclpy.create_node("texts")
    named = [argument.split("=") for argument in sys.argv[1:]]
    publishers = [node.create_publisher(String, name, QUALITIES[quality]) for name, quality in named]
    print("ready", flush=True)
    number = 0
    while rclpy.ok():
        for publisher in publishers:
            publisher.publish(String(data=f"{publisher.topic_name} {number}"))
        number += 1
        time.sleep(0.1)


if __name__ == "__main__":
    main()
