"""A stream places its sweeps where a recording of the same messages does, whatever their types and frames are."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import closing
from pathlib import Path

import bags
import numpy as np
import pytest

from aero_planner.onboard.ros_points import decode_custom
from aero_viz.live.assembly import Assembler
from aero_viz.live.setup import Wanted, find_setup
from aero_viz.live.stream import Stream
from aero_viz.recordings import RecordingSource, open_recording
from tests.captures import laser_scan

SPEED = 2.0
TURNED = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))


def poses(kind: str, *, child: str = "lidar") -> list[bags.Item]:
    """Return poses of a flight along x, 40 a second."""
    places = [(0.025 * k, (SPEED * 0.025 * k, 1.0, 2.0)) for k in range(45)]
    if kind == "odometry":
        return [bags.odometry(t, p, twist=(SPEED, 0, 0), child=child) for t, p in places]
    if kind == "pose":
        return [bags.pose_stamped(t, p) for t, p in places]
    return [bags.transform(t, "odom", child, p) for t, p in places]


def clouds(kind: str) -> list[bags.Item]:
    """Return ten sweeps of a wall."""
    times = [0.1 * k for k in range(10)]
    if kind == "livox":
        offsets = np.linspace(0, 9e7, 200).astype(int)
        return [bags.livox(t, bags.wall(seed=k) - [SPEED * t, 0, 0], offsets) for k, t in enumerate(times)]
    if kind == "depth":
        depth = np.full((12, 16), 4.0, np.float32)
        images = [bags.depth_image(t, depth - np.float32(SPEED * t)) for t in times]
        return [bags.camera_info(0.0, (20.0, 20.0, 8.0, 6.0), depth.shape), *images]
    frame = "odom" if kind == "world" else "lidar"
    moved = 0.0 if kind == "world" else SPEED
    return [bags.cloud(t, bags.xyz(bags.wall(seed=k) - [moved * t, 0, 0]), frame=frame) for k, t in enumerate(times)]


def mount(parent: str, child: str) -> list[bags.Item]:
    return [bags.transform(0.0, parent, child, (0.3, 0.0, -0.1), TURNED, topic="/tf_static")]


CASES = {
    "PointCloud2, Odometry": [*clouds("cloud"), *poses("odometry")],
    "PointCloud2, PoseStamped": [*clouds("cloud"), *poses("pose")],
    "PointCloud2, TF": [*clouds("cloud"), *poses("tf")],
    "PointCloud2 of the world, Odometry": [*clouds("world"), *poses("odometry", child="body")],
    "CustomMsg, Odometry": [*clouds("livox"), *poses("odometry")],
    "LaserScan, Odometry": [*(laser_scan(0.1 * k) for k in range(10)), *poses("odometry", child="laser")],
    "depth image, TF": [*clouds("depth"), *poses("tf", child="body"), *mount("body", "camera_optical_frame")],
    "PointCloud2 of a mounted sensor, Odometry": [
        *clouds("cloud"), *poses("odometry", child="base"), *mount("base", "lidar"),
    ],
    "PointCloud2 of a mounted sensor, TF": [*clouds("cloud"), *poses("tf", child="base"), *mount("base", "lidar")],
    "PointCloud2, Odometry whose axes point down": [
        *(bags.cloud(0.1 * k, bags.xyz(bags.wall(seed=k)), frame="fcu_frd") for k in range(10)),
        *poses("odometry", child="fcu_frd"),
    ],
}  # fmt: skip


def in_order(items: Iterable[bags.Item]) -> list[bags.Item]:
    return sorted(items, key=lambda item: item.time)


@pytest.mark.parametrize("items", CASES.values(), ids=CASES)
def test_a_stream_places_sweeps_as_a_recording_does(tmp_path: Path, items: list[bags.Item]):
    stream, store = Stream("types"), bags.STORES[False]
    for item in in_order(items):
        data = bytes(store.serialize_cdr(item.build(store, False), item.type_name))
        stream.add(item.topic, item.type_name, data, time=item.time)
    setup = find_setup(stream, Wanted())
    assembler = Assembler(stream, setup)
    for message in stream.messages():
        assembler.add(message)
    live = assembler.inputs(in_order(items)[-1].time)
    assert not any(health.unused for health in stream.topics.values())

    with closing(RecordingSource(open_recording(bags.write_mcap(tmp_path / "types.mcap", in_order(items))))) as source:
        assert source.recording.poses is not None and source.info.times is not None
        source.seek(float(source.info.times[-1]))
        recorded = source.observe()
        offset = source.recording.poses.offset
    assert len(live.sweeps) == len(recorded.sweeps)
    for ours, theirs in zip(live.sweeps, recorded.sweeps, strict=True):
        np.testing.assert_allclose(ours, theirs + offset, atol=2e-3)
    np.testing.assert_allclose(np.asarray(live.state.velocity), np.asarray(recorded.state.velocity), atol=1e-3)
    np.testing.assert_allclose(np.asarray(live.state.quaternion), np.asarray(recorded.state.quaternion), atol=1e-9)


@pytest.mark.parametrize("frame", ["", "a", "lidar", "livox_frame", "livox_frame_left"])
def test_the_node_reads_custom_messages_as_ros_writes_them(frame: str):
    store, points = bags.STORES[False], bags.wall(seed=0)[:3]
    item = bags.livox(0.0, points, np.arange(3) * 10_000_000)
    message = item.build(store, False)
    message.header.frame_id, message.timebase = frame, 100 * 10**9
    found, stamps, tags = decode_custom(bytes(store.serialize_cdr(message, item.type_name)))
    np.testing.assert_array_equal(found, points.astype(np.float32))
    np.testing.assert_allclose(stamps, 100.0 + np.arange(3) * 0.01)
    assert not tags.any()
