"""`aero-viz live` on a Livox that sends packets, and on a capture of them, as another program of the graph sees it."""

from __future__ import annotations

import itertools
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from aero_planner.onboard.livox import encode_packet
from aero_planner.onboard.ros_definitions import CLOUD
from aero_planner.quaternions import quaternion_from_angles, rotation_matrix
from aero_viz.ros.graph import Graph
from tests.captures import livox_imu_packet, write_pcap
from tests.cli.programs import interrupt, read_line
from tests.live.conftest import walls
from tests.ros.conftest import points_of, wait_until

PITCH, ROLL, HEIGHT = 30.0, 10.0, 1.5
"""The sensor looks down on the body [deg], which is tilted [deg] and stands still above the floor [m]."""
PERIOD = 5_000_000
"""Time between two packets [ns]."""
PORT = 56301


def packets() -> Iterator[tuple[int, int, bytes]]:
    """Return packets without an end: their times [ns], offsets of their ports from that of the points, and bytes."""
    to_sensor = rotation_matrix(quaternion_from_angles(ROLL, 0.0, 0.0)) @ rotation_matrix(
        quaternion_from_angles(0.0, PITCH, 0.0)
    )
    seen = (walls(20_000) - (0.0, 0.0, HEIGHT)) @ to_sensor
    up = to_sensor[2].tolist()
    random = np.random.default_rng(0)
    for number in itertools.count():
        stamp = PERIOD * number
        points = seen[random.integers(0, len(seen), 96)]
        yield stamp, 100, livox_imu_packet(stamp, rates=(0.0, 0.0, 0.0), forces=up)
        yield stamp, 0, encode_packet(points, stamp_ns=stamp, interval=4.9e-3, sequence=number)


def send(port: int, ended: threading.Event) -> None:
    began = time.monotonic_ns()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for stamp, offset, data in packets():
            if ended.wait(max(began + stamp - time.monotonic_ns(), 0) * 1e-9):
                return
            sender.sendto(data, ("127.0.0.1", port + offset))


def free_port() -> int:
    """Return a port that is free as well as the one for the IMU."""
    while True:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as first:
            first.bind(("0.0.0.0", 0))
            port = first.getsockname()[1]
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as second:
                try:
                    second.bind(("0.0.0.0", port + 100))
                except OSError:
                    continue
                return port


@pytest.mark.parametrize("source", ["--livox", "--pcap-replay"])
def test_the_mounting_and_the_imu_make_the_floor_level(graph: Graph, tmp_path: Path, source: str):
    pytest.importorskip("rko_lio", reason="the extra 'odometry' is not installed")
    ended, port = threading.Event(), free_port()
    sender = threading.Thread(target=send, args=(port, ended))
    if source == "--livox":
        place = f"127.0.0.1:{port}"
        sender.start()
    else:
        kept = itertools.takewhile(lambda packet: packet[0] < 10_000_000_000, packets())
        place = str(write_pcap(tmp_path / "desk.pcap", [(1e-9 * at, PORT + offset, data) for at, offset, data in kept]))
    clouds: list[np.ndarray] = []
    graph.subscribe("/aero_viz/plan/filtered", CLOUD, lambda message: clouds.append(points_of(message)))
    command = [sys.executable, "-m", "aero_viz", "live", source, place, "--odometry", "rko-lio", "--imu", "/livox/imu"]
    command += ["--extrinsic", "0", "0", "0", "0", f"{PITCH}", "0", "--ros-out", "--port", "0"]
    printed = ""
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            while " at http" not in (line := read_line(process)):
                assert process.poll() is None, process.communicate()[1]
                printed += line
            wait_until(lambda: len(clouds) > 5, timeout=120.0)
        finally:
            ended.set()
        interrupt(process)
    assert "clouds from /livox/lidar in the frame 'livox_frame'" in printed
    assert "turned by the quaternion 0.966 0.000 0.259 0.000" in printed
    points = clouds[-1]
    error = np.minimum(np.abs(points[:, 2] + HEIGHT), np.abs(np.abs(points[:, 1]) - 3.0))
    assert len(points) > 100 and np.mean(error < 0.15) > 0.9
