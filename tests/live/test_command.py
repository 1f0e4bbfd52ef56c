"""`aero-viz live` on a recording as a user starts it, where there is no ROS 2, and what it refuses."""

from __future__ import annotations

import subprocess
import sys

import pytest
from command_line import run_refused

from tests.cli.programs import interrupt, read_line

RECORDING = "aero_viz/datasets/room_mid360.mcap"
WITHOUT_ROS = "import sys; sys.modules['rclpy'] = None; from aero_viz.__main__ import main; sys.exit(main())"


def test_a_recording_is_replayed_without_ros():
    command = [sys.executable, "-c", WITHOUT_ROS, "live", "--pcap-replay", RECORDING, "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        printed = ""
        while " at http" not in (line := read_line(process)):
            assert process.poll() is None, printed
            printed += line
        interrupt(process)
    assert "clouds from /sweep in the frame 'body'" in printed and "poses from /odometry" in printed


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--livox", "192.168.1.142", "--pcap-replay", RECORDING], "are two sources; give one"),
        (["--pcap-replay", RECORDING, "--list"], "--list and --domain are about ROS 2"),
        (["--pcap-replay", "no_such.pcap"], "no_such.pcap does not exist"),
        (["--pcap-replay", RECORDING, "--goal", "1e9", "0", "2"], "A goal is within 1e+06 m of the origin"),
        (["--pcap-replay", RECORDING, "--odometry", "rko-lio"], "rko-lio needs an IMU"),
        (
            ["--pcap-replay", RECORDING, "--extrinsic", "nan", "0", "0", "0", "0", "0"],
            "--extrinsic takes six finite numbers",
        ),
        (
            ["--pcap-replay", RECORDING, "--mask", "1", "0", "0", "0", "1", "1"],
            "--mask takes the lower corner of a box",
        ),
        (["--imu", "/imu"], "--imu is a topic, such as /livox/imu, for --odometry rko-lio, not '/imu' for None"),
        (["--odometry", "rko-lio", "--imu", "imu"], "--imu is a topic, such as /livox/imu"),
        (["--livox", "127.0.0.1:65500"], "a port up to 65435, not 127.0.0.1:65500"),
        (["--livox", "127.0.0.1:first"], "a port up to 65435, not 127.0.0.1:first"),
        (["--rate", "0"], "--rate is in [0.1, 200] Hz"),
        (["--points", "points"], "--points is a topic, such as /points, not 'points'"),
        (["--odometry", "icp"], "--odometry is a topic, such as /Odometry, or kiss-icp or rko-lio, not 'icp'"),
        (["--goal", "1", "2"], "or three numbers x y z [m], not 1 2"),
        (["--folder", "."], "--folder has no effect here"),
        (["--record", RECORDING], "exists"),
    ],
)
def test_what_is_wrong_is_said(capsys: pytest.CaptureFixture[str], arguments: list[str], said: str):
    assert said in run_refused(capsys, "live", *arguments)
