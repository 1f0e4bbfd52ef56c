"""Frames: axes that names tell, clouds that are said to be in the frame of the world, and mountings without poses."""

import bags
import numpy as np
import pytest

from aero_planner.quaternions import rotation_matrix
from aero_viz.recordings import inspect, open_recording

WALL = bags.wall(400)
AXES = {
    "camera_depth_optical_frame": WALL[:, [1, 2, 0]] * [-1, -1, 1],
    "zed2_left_camera_optical": WALL[:, [1, 2, 0]] * [-1, -1, 1],
    "kinect2_rgb_optical_frame_2": WALL[:, [1, 2, 0]] * [-1, -1, 1],
    "base_link_frd": WALL * [1, -1, -1],
    "camera_link": WALL,
    "optical_bench_lidar": WALL,
}
"""The points of a wall 5 m in front of a sensor, in frames of these names."""


@pytest.mark.parametrize("frame", AXES)
@pytest.mark.parametrize("poses", ["none", "of another frame", "of the sensor", "of tf"])
def test_the_name_of_a_frame_tells_its_axes(mcap_of, frame, poses):
    items = [bags.cloud(0.1 * k, bags.xyz(AXES[frame]), frame=frame) for k in range(6)]
    # The sensor flies forward, towards the wall; the axes of its own frame are turned in the world.
    matrix = np.linalg.lstsq(AXES[frame], WALL, rcond=None)[0].T
    half = 0.5 * np.sqrt(1 + np.trace(matrix))
    own = (
        [half, *(matrix[i, j] - matrix[j, i] for i, j in ((2, 1), (0, 2), (1, 0)))] / np.array([1, *3 * [4 * half]])
        if half > 0.1
        else np.array([0.0, 1.0, 0.0, 0.0])
    )
    if poses == "of another frame":
        items += [bags.odometry(0.1 * k, [0.2 * k, 0, 0], child="base_link") for k in range(6)]
    elif poses == "of the sensor":
        items += [bags.odometry(0.1 * k, [0.2 * k, 0, 0], own, child=frame) for k in range(6)]
    elif poses == "of tf":
        items += [bags.transform(0.1 * k, "odom", frame, [0.2 * k, 0, 0], own) for k in range(6)]
    with open_recording(mcap_of(items)) as recording:
        np.testing.assert_allclose(recording.sweep(3).points, WALL, atol=1e-5)
        is_turned = AXES[frame] is not WALL
        assert any("by its name" in text for text in recording.problems) == is_turned
        if recording.poses is not None:
            pose = recording.poses.interpolate(0.3)
            np.testing.assert_allclose(rotation_matrix(pose.quaternion), np.eye(3), atol=1e-6)
            np.testing.assert_allclose(pose.velocity, [2, 0, 0], atol=1e-6)


def test_static_transforms_mount_a_sensor_without_poses(mcap_of):
    frame, points = "camera_optical_frame", bags.xyz(AXES["camera_depth_optical_frame"])
    items = [bags.transform(0, "base", frame, [0.1, 0, 0], [0.5, -0.5, 0.5, -0.5], topic="/tf_static")]
    items += [bags.cloud(0.1 * k, points, frame=frame) for k in range(3)]
    with open_recording(mcap_of(items)) as recording:
        np.testing.assert_allclose(recording.sweep(0).points, WALL + np.array([0.1, 0, 0]), atol=1e-5)
        assert any("mounted on 'base'" in text for text in recording.problems)
    with open_recording(mcap_of(items), extrinsic=(0, 0, 0, 0, 0, 0)) as recording:
        np.testing.assert_allclose(recording.sweep(0).points, AXES["camera_depth_optical_frame"], atol=1e-5)


def room(seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    points = random.uniform([-6, -4, 0], [9, 5, 3], (4000, 3))
    sides = random.integers(0, 4, len(points))
    points[sides == 0, 0], points[sides == 1, 1], points[sides == 2, 2], points[sides == 3, 0] = 9, -4, 0, -6
    return points


def pose_of(motion: str, k: int) -> tuple[np.ndarray, np.ndarray]:
    half = 0.075 * k if motion == "turns" else 0.0
    return np.array([0.2 * k if motion == "flies" else 0.0, 0, 1]), np.array([np.cos(half), 0, 0, np.sin(half)])


def flight(motion: str, moves_with: str, frame: str) -> list[bags.Item]:
    """Return clouds of a room and the poses of a body that flies ahead or turns on the spot."""
    items = []
    for k in range(20):
        place, quaternion = pose_of(motion, k)
        points = room(k)
        if moves_with == "body":
            points = (points - place) @ rotation_matrix(quaternion)
        items.append(bags.cloud(0.1 * k, bags.xyz(points), frame=frame))
        items.append(bags.odometry(0.1 * k, place, quaternion, parent="map", child="body"))
    return items


@pytest.mark.parametrize("motion", ["flies", "turns"])
@pytest.mark.parametrize("moves_with", ["body", "world"])
@pytest.mark.parametrize("frame", ["body", "map"])
def test_clouds_that_move_otherwise_than_their_frame_are_found(mcap_of, motion, moves_with, frame):
    path = mcap_of(flight(motion, moves_with, frame))
    codes = [finding.code for finding in inspect(path).findings]
    expected = {("body", "map"): ["body-frame"], ("world", "body"): ["world-frame"]}.get((moves_with, frame), [])
    assert [code for code in codes if code.endswith("-frame")] == expected
    with open_recording(path) as recording:
        assert any("turn and move with the body" in text for text in recording.problems) == (expected == ["body-frame"])
    with open_recording(path, cloud_frame=moves_with) as recording:
        assert recording.is_in_world == (moves_with == "world")
        for k in (0, 13):
            place, quaternion = pose_of(motion, k)
            expected_points = (room(k) - place) @ rotation_matrix(quaternion)
            np.testing.assert_allclose(recording.sweep(k).points, expected_points, atol=1e-4)
