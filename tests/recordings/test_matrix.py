"""Every container with every type of cloud and every source of poses, written by the libraries' own writers."""

from collections.abc import Callable
from pathlib import Path

import bags
import numpy as np
import pytest
from captures import laser_scan

from aero_viz.recordings import RecordingSource, open_recording

OFFSETS = np.arange(200) * 400_000
NANOSECONDS = OFFSETS.astype("u4")
SPEED = 2.0
MOUNT = np.array([0.5, 0.0, 0.25])
"""Position of the sensor on its body."""


def organised(seconds: float, points: np.ndarray) -> bags.Item:
    """Return a cloud of four rows as a handheld Ouster records it, of which a row has no returns."""
    padded = np.vstack([points[:150], np.full((25, 3), np.nan), np.zeros((25, 3))])
    columns = {
        **bags.xyz(padded),
        "intensity": np.ones(200, "f4"),
        "t": NANOSECONDS,
        "ring": np.arange(200, dtype="u2"),
    }
    return bags.cloud(seconds, columns, point_step=48, height=4, row_padding=16)


CLOUDS: dict[str, Callable[[float, np.ndarray], bags.Item]] = {
    "plain": lambda at, points: bags.cloud(at, {**bags.xyz(points), "t": NANOSECONDS}),
    "big-endian": lambda at, points: bags.cloud(at, {**bags.xyz(points, "f8"), "t": NANOSECONDS}, big_endian=True),
    "organised": organised,
    "livox": lambda at, points: bags.livox(at, points, OFFSETS),
    "livox 1": lambda at, points: bags.livox(at, points, OFFSETS, "livox_ros_driver"),
    "livox interfaces": lambda at, points: bags.livox(at, points, OFFSETS, "livox_interfaces"),
    "foxglove": lambda at, points: bags.foxglove_ros(at, points, OFFSETS, (1.0, 2.0, 3.0)),
    "old": bags.point_cloud,
    "scan": lambda at, _: laser_scan(at),
}


def move(source: str, at: float, frame: str) -> list[bags.Item]:
    """Return the messages that place the sensor at x = 2 t."""
    position = (SPEED * at, 0.0, 0.0)
    if source == "odometry":
        return [bags.odometry(at, position, twist=(SPEED, 0, 0), child=frame)]
    if source == "tf":
        return [
            bags.transform(at, "odom", "base", position),
            bags.transform(0.0, "base", frame, (0, 0, 0), topic="/tf_static"),
        ]
    return [bags.pose_stamped(at, position)] if source == "pose" else []


@pytest.mark.parametrize("source", ["odometry", "tf", "pose", "none"])
@pytest.mark.parametrize("kind", CLOUDS)
def test_a_wall_stays_where_it_is(tmp_path: Path, kind: str, source: str):
    points, items = bags.wall(), []
    frame = "laser" if kind == "scan" else "lidar"
    for k in range(16):
        items += move(source, 0.025 * k, frame)
    for k in range(4):
        at = 0.1 * k
        moved = points - np.outer(SPEED * (at + (0 if kind == "old" else 1e-9) * OFFSETS), [1, 0, 0])
        items.append(CLOUDS[kind](at, moved if source != "none" else points))
    for name, write in bags.FORMATS.items():
        folder = tmp_path / name
        folder.mkdir()
        with open_recording(write(folder, sorted(items, key=lambda item: item.time))) as recording:
            assert (recording.poses is None) == (source == "none"), name
            assert [len(recording.sweep(k).points) for k in (3, 0, 2)] == [len(recording.sweep(1).points)] * 3, name
            if recording.poses is not None:
                np.testing.assert_allclose(recording.poses.velocities, np.tile([SPEED, 0, 0], (16, 1)), atol=1e-6)
            assert (recording.sweep(0).point_times is None) == (kind == "old"), name
            offset = np.zeros(3) if recording.poses is None else recording.poses.offset
            seen = RecordingSource(recording).observe().points + offset
            if kind == "scan":
                assert len(seen) == 81 and np.abs(np.linalg.norm(seen, axis=1) - 3.0).max() < 0.3, name
            else:
                np.testing.assert_allclose(seen, points[: len(seen)], atol=2e-2, err_msg=name)
                assert len(seen) == (150 if kind == "organised" else 200), name
