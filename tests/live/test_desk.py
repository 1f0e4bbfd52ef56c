"""A sensor on the desk: packets of a Livox and captures become a stream, and odometry finds its poses."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from aero_planner.onboard.livox import encode_packet
from aero_planner.quaternions import rotation_matrix
from aero_viz.errors import UserError
from aero_viz.live.livox import POINTS_TOPIC, LivoxFeed
from aero_viz.live.odometry import TOPIC, OnlineOdometry
from aero_viz.live.player import Player
from aero_viz.live.setup import Wanted, find_setup
from aero_viz.live.source import StreamSource
from aero_viz.live.stream import Stream
from aero_viz.recordings.imu_messages import GRAVITY, IMU_TYPE, encode_imu
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
    feed = LivoxFeed(stream, "127.0.0.1:0")
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
            LivoxFeed(Stream("desk"), f"127.0.0.1:{other.getsockname()[1]}")


def test_a_sensor_without_an_address_is_said():
    with pytest.raises(UserError, match=r"The Livox no_such\.sensor has no address"):
        LivoxFeed(Stream("desk"), "no_such.sensor")


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


def way(time: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """Return the position along x of a sensor that is at rest, reaches 1 m/s within a second, and keeps it [m]."""
    moving = np.maximum(time, 0.0)
    return np.where(moving < 1.0, 0.5 * moving**2, moving - 0.5)


@pytest.mark.parametrize("method", ["kiss-icp", "rko-lio"])
@pytest.mark.parametrize("extrinsic", [(0.0,) * 6, (0.2, 0.0, 0.1, 0.0, 25.0, 0.0)], ids=["level", "tilted"])
def test_odometry_follows_the_body(method: str, extrinsic: tuple[float, ...]):
    pytest.importorskip(method.replace("-", "_"), reason="the extra 'odometry' is not installed")
    stream = Stream("desk")
    wanted = Wanted(extrinsic=extrinsic)
    turn = rotation_matrix(wanted.mount.quaternion)
    odometry = OnlineOdometry(stream, method, points="/points", imu="/imu", mount=wanted.mount)
    cloud, start = walls(6000), stream.clock.now() - 2_000_000_000
    offsets = np.linspace(0.0, 0.0999, len(cloud)) if method == "rko-lio" else np.zeros(len(cloud))
    for step in range(20):
        stamp, time = start + 100_000_000 * step, 0.1 * step - 0.4
        for sample in range(0, 105, 5):
            now = stamp + 1_000_000 * sample
            force = np.array([float(0.0 <= time + 1e-3 * sample < 1.0), 0.0, GRAVITY]) @ turn
            other = encode_imu(now, "gimbal", (0.0, 3.0, 0.0), (0.0, 0.0, 0.1))
            stream.add("/gimbal/imu", IMU_TYPE, other, time=now)
            stream.add("/imu", IMU_TYPE, encode_imu(now, "sensor", np.zeros(3), force), time=now)
        seen = cloud - np.stack([way(time + offsets), 0.0 * offsets, 0.0 * offsets + 1.5], axis=1)
        seen = (seen - wanted.mount.position) @ turn
        times = offsets.astype(np.float32) if offsets.any() else None
        data = encode_point_cloud2(seen.astype(np.float32), stamp, "sensor", times=times)
        stream.add("/points", POINT_CLOUD2, data, time=stamp + 100_000_000)
        wait_until(lambda step=step: TOPIC in stream.topics and stream.topics[TOPIC].count > step)
    setup = find_setup(stream, wanted)
    assert (setup.poses, setup.twist) == (TOPIC, "none")
    observation = StreamSource(stream, setup).observe()
    np.testing.assert_allclose(np.asarray(observation.state.velocity), [1.0, 0.0, 0.0], atol=0.15)
    _, y, z = np.concatenate(list(observation.sweeps)).T  # from where the body was at first, above the floor
    assert np.mean(np.minimum(np.abs(np.abs(y) - 3.0), np.abs(z + 1.5)) < 0.1) > 0.95
    assert odometry.dropped == 0
    odometry.close()


def test_what_rko_lio_waits_for_is_said():
    pytest.importorskip("rko_lio", reason="the extra 'odometry' is not installed")
    stream = Stream("desk")
    odometry = OnlineOdometry(stream, "rko-lio", points="/points")
    cloud, times = walls(200), np.linspace(0.0, 0.1, 200).astype(np.float32)
    for given, said in ((None, "a time for each point, which /points does not give"), (times, "needs an IMU")):
        stream.add("/points", POINT_CLOUD2, encode_point_cloud2(cloud, 10**9, "sensor", times=given))
        wait_until(lambda said=said: said in odometry.missing)
    odometry.close()
