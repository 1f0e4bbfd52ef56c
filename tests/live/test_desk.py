"""A sensor on the desk: packets of a Livox and captures become a stream, and odometry finds its poses."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from aero_planner.onboard.livox import encode_packet
from aero_viz.errors import UserError
from aero_viz.live.livox import POINTS_TOPIC, LivoxFeed
from aero_viz.live.odometry import TOPIC, OnlineOdometry
from aero_viz.live.player import Player
from aero_viz.live.setup import Wanted, find_setup
from aero_viz.live.source import StreamSource
from aero_viz.live.stream import Stream
from aero_viz.recordings.point_cloud2 import POINT_CLOUD2, encode_point_cloud2
from tests.captures import livox_packets, write_pcap
from tests.live.conftest import walls


def wait_until(condition: Callable[[], object], timeout: float = 30.0) -> None:
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_the_packets_of_a_livox_become_clouds():
    stream = Stream("desk")
    feed = LivoxFeed(stream, "127.0.0.1", port=0, imu_port=0)
    points = walls(96)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for number in range(80):
            packet = encode_packet(points, stamp_ns=10**12 + 5_000_000 * number, interval=4.9e-3, sequence=number)
            sender.sendto(packet, ("127.0.0.1", feed.ports[0]))
            time.sleep(0.005)
    assert feed.wait(30.0)
    wait_until(lambda: stream.topics[POINTS_TOPIC].count >= 2)
    setup = find_setup(stream, Wanted())
    assert (setup.points, setup.poses, setup.time_unit) == (POINTS_TOPIC, None, 1e-9)
    sweep = StreamSource(stream, setup).observe().sweeps.newest
    np.testing.assert_allclose(np.unique(sweep, axis=0), np.unique(np.round(points, 3), axis=0), atol=1e-3)
    feed.close()


def test_a_port_that_is_taken_is_said():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("0.0.0.0", 0))
        with pytest.raises(UserError, match="end the driver that holds the port"):
            LivoxFeed(Stream("desk"), "127.0.0.1", port=other.getsockname()[1], imu_port=0)


def test_a_capture_is_replayed_at_real_speed(tmp_path: Path):
    packets = [
        (stamp * 1e-9, 56301, encode_packet(points, stamp_ns=stamp, interval=4.9e-3, sequence=number))
        for number, (stamp, points) in enumerate(livox_packets(6))
    ]
    stream, began = Stream("replay"), time.monotonic()
    player = Player(stream, write_pcap(tmp_path / "desk.pcap", packets))
    wait_until(lambda: player.is_over)
    assert time.monotonic() - began >= 0.4
    assert stream.topics[POINTS_TOPIC].count >= 5
    player.close()


def test_a_file_without_messages_of_ros_2_is_refused(tmp_path: Path):
    (tmp_path / "cloud.pcap").write_bytes(b"no capture")
    with pytest.raises(UserError, match=r"cloud\.pcap is not a recording"):
        Player(Stream("replay"), tmp_path / "cloud.pcap")


def test_odometry_follows_the_sensor():
    pytest.importorskip("kiss_icp", reason="the extra 'odometry' is not installed")
    stream = Stream("desk")
    odometry = OnlineOdometry(stream, "kiss-icp")
    cloud, start = walls(6000), stream.clock.now() - 1_500_000_000
    for step in range(15):
        stamp = start + 100_000_000 * step
        seen = cloud - np.array([0.1 * step, 0.0, 1.5], np.float32)
        stream.add("/points", POINT_CLOUD2, encode_point_cloud2(seen, stamp, "sensor"), time=stamp)
        wait_until(lambda step=step: TOPIC in stream.topics and stream.topics[TOPIC].count > step)
    setup = find_setup(stream, Wanted())
    assert (setup.poses, setup.twist) == (TOPIC, "none")
    state = StreamSource(stream, setup).observe().state
    np.testing.assert_allclose(np.asarray(state.velocity), [1.0, 0.0, 0.0], atol=0.15)
    assert odometry.dropped == 0
    odometry.close()
