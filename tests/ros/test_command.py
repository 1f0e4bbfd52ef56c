"""`aero-viz live` as a user starts it, beside a driver."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from aero_planner.onboard.ros_definitions import CLOUD
from aero_viz.ros.feed import missing_package, readable_type
from aero_viz.ros.graph import Graph, Topic
from tests.cli.programs import interrupt, read_line
from tests.ros.conftest import Start

LIVE = [sys.executable, "-m", "aero_viz", "live"]


def test_it_says_what_it_takes_and_what_it_assumes(start: Start):
    start("tests.ros.driver")
    with subprocess.Popen([*LIVE, "--port", "0"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        printed = ""
        while " at http" not in (line := read_line(process)):
            assert process.poll() is None, printed
            printed += line
        interrupt(process)
    assert "/points" in printed and "<- can be read" in printed
    assert "clouds from /points in the frame 'lidar', which moves with the body" in printed
    assert "poses from /odometry: 'lidar' in 'odom'" in printed


def test_the_graph_is_listed(start: Start):
    start("tests.ros.driver")
    done = subprocess.run([*LIVE, "--list", "--json"], capture_output=True, text=True, timeout=60)
    found = {topic["name"]: topic for topic in json.loads(done.stdout)["topics"]}
    assert found["/points"] == {
        "name": "/points", "type": "sensor_msgs/msg/PointCloud2", "publishers": 1, "readable": True,
    }  # fmt: skip


def test_what_another_program_of_ours_publishes_is_listed(domain: int):
    with Graph() as ours:  # as --ros-out does
        ours.publisher("/aero_viz/odometry", "nav_msgs/msg/Odometry")
        done = subprocess.run([*LIVE, "--list", "--json"], capture_output=True, text=True, timeout=60)
    assert "/aero_viz/odometry" in [topic["name"] for topic in json.loads(done.stdout)["topics"]]


def test_the_goal_follows_a_topic_that_is_no_pose_of_the_drone(start: Start):
    start("tests.ros.driver", "--no-odometry", "--cloud-topic", "/leader/points", "--node", "leader")
    start("tests.ros.driver", "--no-odometry")
    with Graph("leader") as leader:
        publisher = leader.publisher("/leader/odometry", "nav_msgs/msg/Odometry")
        command = [*LIVE, "--port", "0", "--points", "/points", "--goal", "/leader/odometry"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            printed = ""
            while " at http" not in (line := read_line(process)):
                assert process.poll() is None, printed
                printed += line
            assert publisher.get_subscription_count() == 1
            interrupt(process)
    assert "no poses" in printed


def test_a_goal_from_clouds_is_refused(start: Start):
    start("tests.ros.driver")
    done = subprocess.run([*LIVE, "--goal", "/points"], capture_output=True, text=True, timeout=90)
    assert done.returncode == 2
    assert "--goal /points has sensor_msgs/msg/PointCloud2; a goal comes from geometry_msgs" in done.stderr


@pytest.mark.usefixtures("domain")
def test_without_a_driver_the_error_says_what_to_do():
    done = subprocess.run(LIVE, capture_output=True, text=True, timeout=90)
    assert done.returncode == 2
    assert "no topic of clouds that can be read" in done.stderr and "aero-viz live --list" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            ["--points", "/odometry"],
            "of DOMAIN is a nav_msgs/msg/Odometry, not a point cloud; choose /points.",
        ),
        (["--odometry", "/points"], "is a sensor_msgs/msg/PointCloud2, which holds no poses; choose /odometry."),
        (["--odometry", "/odom"], "DOMAIN has no pose topic /odom; did you mean /odometry?"),
        (
            ["--odometry", "rko-lio", "--imu", "/points"],
            "/points of DOMAIN is a sensor_msgs/msg/PointCloud2, which holds",
        ),
    ],
)
def test_a_topic_that_is_of_no_use_is_refused(start: Start, domain: int, arguments: list[str], said: str):
    start("tests.ros.driver")
    done = subprocess.run([*LIVE, *arguments], capture_output=True, text=True, timeout=90)
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert said.replace("DOMAIN", f"ROS 2 domain {domain}") in done.stderr


def test_a_publisher_that_is_silent_is_named(graph: Graph):
    graph.publisher("/points", CLOUD)
    done = subprocess.run(LIVE, capture_output=True, text=True, timeout=90)
    assert done.returncode == 2 and "Nothing arrives on /points. Listened for 12 s." in done.stderr


def test_a_topic_whose_messages_are_not_installed_says_what_it_needs():
    custom = Topic("/livox/lidar", ("livox_ros_driver2/msg/CustomMsg",), 1)
    assert (readable_type(custom), missing_package(custom)) == (None, "livox_ros_driver2")
    assert missing_package(Topic("/points", (CLOUD,), 1)) is None
    assert missing_package(Topic("/texts", ("std_msgs/msg/String",), 1)) is None
