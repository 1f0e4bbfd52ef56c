"""`aero-viz live` as a user starts it, beside a driver."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from tests.cli.programs import interrupt, read_line
from tests.ros.conftest import Start


def test_it_says_what_it_takes_and_what_it_assumes(start: Start):
    start("tests.ros.driver")
    command = [sys.executable, "-m", "aero_viz", "live", "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
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
    command = [sys.executable, "-m", "aero_viz", "live", "--list", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    found = {topic["name"]: topic for topic in json.loads(done.stdout)["topics"]}
    assert found["/points"] == {
        "name": "/points", "type": "sensor_msgs/msg/PointCloud2", "publishers": 1, "readable": True,
    }  # fmt: skip


@pytest.mark.usefixtures("domain")
def test_without_a_driver_the_error_says_what_to_do():
    done = subprocess.run([sys.executable, "-m", "aero_viz", "live"], capture_output=True, text=True, timeout=90)
    assert done.returncode == 2
    assert "no topic of clouds that can be read" in done.stderr and "aero-viz live --list" in done.stderr
