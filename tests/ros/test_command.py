"""`aero-viz live` as a user starts it, beside a driver."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from aero_viz.ros.graph import Graph
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
