"""Recordings of several sensors, of which one is played, and captures of every kind of link."""

from pathlib import Path

import bags
import numpy as np
import pytest
from captures import velodyne_packet, write_frames, write_lvx2
from command_line import run_json, run_refused

from aero_planner.onboard.livox import encode_packet
from aero_viz.errors import UserError
from aero_viz.recordings import inspect, open_recording
from aero_viz.recordings.imu import read_imu
from aero_viz.recordings.storage import open_storage

pytest.importorskip("velodyne_decoder", reason="the extra 'formats' is not installed")

WALL = bags.wall(96)
START = 1_700_000_000


def livox_frames(addresses: dict[str, int], sweeps: int = 3) -> list[tuple[float, str, bytes]]:
    """Return packets of Mid-360s at addresses, which send so many packets of points in 100 ms, x + 1 m per sensor."""
    frames = []
    for place, (address, count) in enumerate(addresses.items()):
        for i in range(sweeps * count):
            stamp = START * 10**9 + i * 100_000_000 // count
            packet = encode_packet(np.add(WALL, [place, 0, 0]), stamp_ns=stamp, interval=4e-4, sequence=i)
            frames.append((1e-9 * stamp, f"{address}/56301", packet))
    return sorted(frames, key=lambda frame: frame[0])


def velodyne_frames(names: dict[str, float]) -> list[tuple[float, str, bytes]]:
    """Return packets of three turns of VLP-16s, which send to a port each, by the distance that they measure [m]."""
    frames = []
    for i in range(3 * 75 + 10):
        time = 1327e-6 * i
        for name, distance in names.items():
            frames.append((START + time, name, velodyne_packet(480 * i, round(1e6 * time), distance)))
    return frames


LINKS = ["ethernet", "vlan", "two vlans", "cooked", "cooked 2", "loopback", "raw", "raw of BSD", "IP"]


@pytest.mark.parametrize("ng", [False, True])
@pytest.mark.parametrize("link", LINKS)
def test_captures_of_every_link_play(tmp_path: Path, link: str, ng: bool):
    livox = write_frames(tmp_path / "a.pcap", livox_frames({"192.168.1.12": 10}), link=link, ng=ng)
    with open_recording(livox) as recording:
        np.testing.assert_allclose(recording.sweep_times, [0.0, 0.1, 0.2], atol=1e-9)
        np.testing.assert_allclose(recording.sweep(1).points[:96], WALL, atol=1e-3)
    velodyne = write_frames(tmp_path / "b.pcap", velodyne_frames({"192.168.1.201/2368": 8.0}), link=link, ng=ng)
    with open_recording(velodyne) as recording:
        assert recording.format == "velodyne-pcap" and 3 <= len(recording.sweep_times) <= 4
        np.testing.assert_allclose(np.linalg.norm(recording.sweep(1).points, axis=1), 8.0, atol=0.1)


def test_packets_over_ipv6_play(tmp_path: Path):
    with open_recording(write_frames(tmp_path / "a.pcap", livox_frames({"fe80::12": 10}))) as recording:
        assert len(recording.sweep_times) == 3


def test_of_two_mid360_the_one_with_more_points_is_played_and_the_other_is_named(tmp_path: Path):
    path = write_frames(tmp_path / "a.pcap", livox_frames({"192.168.1.11": 5, "192.168.1.12": 10}))
    with open_recording(path) as recording:
        assert recording.sweep_counts.tolist() == [960, 960, 960]
        np.testing.assert_allclose(recording.sweep(1).points[:96], WALL + np.array([1, 0, 0]), atol=1e-3)
        said = "of 2 sensors, 192.168.1.12 (2880 points) is played; --sensor plays 192.168.1.11 (1440 points)"
        assert said in recording.problems
    for wanted in ("192.168.1.11", ".11"):
        with open_recording(path, sensor=wanted) as recording:
            np.testing.assert_allclose(recording.sweep(1).points[:96], WALL, atol=1e-3)
    for wanted, text in (("192.168", "several sensors fit"), ("13", "no sensor is called 13"), ("", "no sensor")):
        with pytest.raises(UserError, match=text):
            open_recording(path, sensor=wanted)


@pytest.mark.parametrize("names", [("192.168.1.201/2368", "192.168.1.202/2368"), ("10.0.0.1/2368", "10.0.0.1/2369")])
def test_pairs_of_velodynes_are_not_mixed(tmp_path: Path, names: tuple[str, str]):
    path = write_frames(tmp_path / "a.pcap", velodyne_frames({names[0]: 8.0, names[1]: 4.0}))
    for name, distance in zip(names, (8.0, 4.0), strict=True):
        with open_recording(path, sensor=name.replace("/", ":")) as recording:
            np.testing.assert_allclose(np.linalg.norm(recording.sweep(1).points, axis=1), distance, atol=0.1)
    assert any("of 2 sensors" in text for text in inspect(path).problems)


def test_sensors_of_an_lvx2_are_not_mixed_and_mounted_as_the_file_says(tmp_path: Path):
    packets = [(START * 10**9 + 5_000_000 * i, np.add(WALL, [i % 3 == 0, 0, 0])) for i in range(60)]
    path = write_lvx2(
        tmp_path / "a.lvx2",
        packets,
        poses={1: (180.0, 0.0, 0.0, 0.0, 0.0, 0.5), 0x0C01A8C0: None},
        sensors=[0x0C01A8C0 if i % 3 == 0 else 1 for i in range(60)],
    )
    with open_recording(path) as recording:
        np.testing.assert_allclose(recording.sweep(1).points[:96], WALL * [1, -1, -1] + [0, 0, 0.5], atol=2e-3)
        assert any("mounts the sensor SN1" in text and "180 0 0 deg" in text for text in recording.problems)
        assert any("--sensor plays SN201435328 (1920 points)" in text for text in recording.problems)
    with open_recording(path, sensor="SN2") as recording:
        np.testing.assert_allclose(recording.sweep(1).points[:96], WALL + np.array([1, 0, 0]), atol=2e-3)
    with open_recording(path, extrinsic=(0, 0, 1, 0, 0, 0)) as recording:
        np.testing.assert_allclose(recording.sweep(1).points[:96], WALL + np.array([0, 0, 1]), atol=2e-3)


def test_livox_sensors_on_one_topic_are_not_mixed(mcap_of):
    offsets = np.arange(96) * 1000
    items = [bags.livox(0.1 * k + 0.01 * n, WALL[: 96 - 40 * n], offsets[: 96 - 40 * n], lidar=n) for k in range(5)
             for n in range(2)]  # fmt: skip
    path = mcap_of(items)
    with open_recording(path) as recording:
        assert recording.sweep_counts.tolist() == [96] * 5
        assert any("--sensor plays lidar lidar 1 (280 points)" in text for text in recording.problems)
    with open_recording(path, sensor="lidar 1") as recording:
        assert recording.sweep_counts.tolist() == [56] * 5


def test_the_topic_with_the_most_points_a_second_is_played_and_the_others_are_named(mcap_of):
    radar = [bags.cloud(0.02 * k, bags.xyz(WALL[:8]), topic="/radar", frame="radar") for k in range(50)]
    lidar = [bags.cloud(0.1 * k, bags.xyz(bags.wall(541)), topic="/lidar") for k in range(10)]
    path = mcap_of([*radar, *lidar])
    with open_recording(path) as recording:
        assert recording.points_topic == "/lidar"
        (said,) = [text for text in recording.problems if "topics of clouds" in text]
        assert "/lidar (5520 points a second)" in said and "--points-topic plays /radar (408 points a second)" in said
    with open_recording(path, points_topic="/radar") as recording:
        assert not any("topics of clouds" in text for text in recording.problems)


def test_a_single_large_cloud_is_a_map_and_no_sensor(mcap_of):
    lidar = [bags.cloud(0.1 * k, bags.xyz(bags.wall(100)), topic="/lidar") for k in range(10)]
    path = mcap_of([*lidar, bags.cloud(0.5, bags.xyz(bags.wall(5000)), topic="/prior_map", frame="site")])
    assert inspect(path).points_topic == "/lidar"


@pytest.mark.parametrize(
    ("payload", "name"),
    [
        (b"\xee\xff\x06\x01" + bytes(1000), "a Hesai"),
        (b"\x55\xaa\x05\x0a\x5a\xa5\x50\xa0" + bytes(1240), "a RoboSense"),
        (b"\x55\xaa\x05\x5a" + bytes(1244), "a RoboSense"),
        (b"\xa5\xff\x00\x5a\x11\x11\x55\x55" + bytes(1240), "a RoboSense"),
        (b"\x05" + bytes(1361), "a Livox of the first generation"),
        (b"\xff\xee" + bytes(1210), "an LSLiDAR"),
    ],
)
def test_packets_of_other_sensors_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], payload: bytes, name: str
):
    path = write_frames(tmp_path / "a.pcap", [(START + 0.01 * k, "192.168.1.201/2368", payload) for k in range(20)])
    error = run_refused(capsys, "inspect", str(path))
    assert f"holds packets of {name}," in error and "PointCloud2" in error


def test_the_imu_is_that_of_the_sensor_that_is_played(tmp_path: Path):
    from captures import livox_imu_packet

    frames = livox_frames({"192.168.1.11": 5, "192.168.1.12": 10})
    frames += [(START + 0.01 * k, "192.168.1.11/56401", livox_imu_packet(START * 10**9 + k)) for k in range(20)]
    path = write_frames(tmp_path / "a.pcap", frames)
    for sensor, count in ((None, 0), (".11", 20)):
        with open_recording(path, sensor=sensor):
            pass
        from aero_viz.recordings.choices import Choices

        storage = open_storage(path, Choices(sensor=sensor))
        imu = read_imu(storage.files)
        storage.close()
        assert (0 if imu is None else len(imu.times)) == count


def test_a_sensor_is_chosen_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = write_frames(tmp_path / "a.pcap", livox_frames({"192.168.1.11": 5, "192.168.1.12": 10}))
    assert run_json(capsys, "inspect", str(path), "--sensor", ".11")["points_per_sweep"]["median"] == 480
    run_json(capsys, "convert", str(path), str(tmp_path / "out.mcap"), "--sensor", ".11")
    assert run_json(capsys, "inspect", str(tmp_path / "out.mcap"))["points_per_sweep"]["median"] == 480
