"""Bags with the packets of a Velodyne."""

import bags
import numpy as np
import pytest
from captures import velodyne_packet

from aero_viz.recordings import open_recording
from aero_viz.recordings.convert import convert

pytest.importorskip("velodyne_decoder", reason="the extra 'formats' is not installed")


def scans(count: int) -> list[bags.Item]:
    """Return turns of a VLP-16 in a round room of 8 m."""
    packets = [(1327e-6 * i, velodyne_packet(480 * i, round(1327 * i), 8.0)) for i in range(75 * count)]
    items = []
    for k in range(count):
        start = packets[75 * k][0]
        turn = [(time - start, packet) for time, packet in packets[75 * k : 75 * k + 75]]
        items.append(bags.velodyne_scan(start, turn))
    return items


def test_packets_in_a_bag_play(written):
    with open_recording(written(scans(3))) as recording:
        assert recording.points_topic == "/velodyne_packets" and recording.cloud_frame == "velodyne"
        np.testing.assert_allclose(recording.sweep_times, [0, 0.0995, 0.199], atol=1e-3)
        sweep = recording.sweep(1)
        np.testing.assert_allclose(np.linalg.norm(sweep.points, axis=1), 8.0, atol=0.1)
        assert len(sweep.points) > 25_000 and sweep.point_times is not None
        assert 0.09 < sweep.point_times.max() < 0.11 and sweep.point_times.min() >= 0.0


def test_clouds_of_the_driver_are_preferred_to_its_packets(mcap_of):
    clouds = [bags.cloud(0.1 * k, bags.xyz(bags.wall(50)), topic="/velodyne_points") for k in range(3)]
    with open_recording(mcap_of([*scans(3), *clouds])) as recording:
        assert recording.points_topic == "/velodyne_points"


def test_packets_convert_to_clouds_and_damaged_ones_are_left_out(mcap_of, tmp_path):
    items = scans(3)
    items[1] = bags.velodyne_scan(0.0995, [(0.0, b"\xff\xee" + bytes(1204))] * 75)
    convert(mcap_of(items), tmp_path / "out.mcap")
    with open_recording(tmp_path / "out.mcap") as recording:
        assert len(recording.sweep(0).points) > 25_000
