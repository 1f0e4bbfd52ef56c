"""Depth images become points by the intrinsics of their camera."""

import bags
import numpy as np
import pytest

from aero_viz.errors import UserError
from aero_viz.recordings import open_recording
from aero_viz.recordings.convert import convert
from aero_viz.recordings.depth_image import Intrinsics, depth_points

CAMERA = Intrinsics(60.0, 62.0, 31.5, 23.0)
SHAPE = (48, 64)


def wall(distance: float) -> np.ndarray:
    """Return the depths of a wall with a hole in it, without returns in a corner."""
    depth = np.full(SHAPE, distance)
    depth[10:20, 30:40] = 5.0
    depth[:4, :4] = 0.0
    return depth


def points_of(depth: np.ndarray) -> np.ndarray:
    """Return the points of all pixels that have a depth, forward, left, up, [P, 3] [m]."""
    found = []
    for v, u in np.ndindex(depth.shape):
        if depth[v, u] > 0.0:
            z = depth[v, u]
            found.append((z, -z * (u - CAMERA.cx) / CAMERA.fx, -z * (v - CAMERA.cy) / CAMERA.fy))
    return np.array(found)


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_depth_images_are_played(written, encoding: str):
    """The intrinsics may come after the first images; those of another camera and its colours do not matter."""
    items = [bags.depth_image(0.1 * k, wall(2.0 + 0.5 * k), encoding=encoding, padding=6) for k in range(4)]
    items += [bags.camera_info(0.15, CAMERA, SHAPE), bags.camera_info(0.0, (9, 9, 1, 1), SHAPE, topic="/color/info")]
    items += [bags.odometry(0.1 * k, [0.2 * k, 0.0, 1.0]) for k in range(4)]
    with open_recording(written(sorted(items, key=lambda item: item.time))) as recording:
        assert recording.points_topic == "/camera/depth/image_raw" and len(recording.sweep_times) == 4
        for k in (0, 3):
            sweep = recording.sweep(k)
            np.testing.assert_allclose(sweep.points, points_of(wall(2.0 + 0.5 * k)), atol=2e-3)
            assert sweep.dropped == 16


def test_a_lidar_is_played_before_a_camera(mcap_of):
    items = [
        *bags.drive(3),
        *(bags.depth_image(0.1 * k, wall(2.0)) for k in range(3)),
        bags.camera_info(0.0, CAMERA, SHAPE),
    ]
    with open_recording(mcap_of(items)) as recording:
        assert recording.points_topic == "/points"


def test_images_without_intrinsics_or_depth_are_no_clouds(mcap_of):
    path = mcap_of([bags.depth_image(0.1 * k, wall(2.0)) for k in range(3)])
    with pytest.raises(UserError, match="no CameraInfo on /camera/depth/camera_info"):
        open_recording(path)
    items = [*bags.drive(3), bags.depth_image(0.1, wall(2.0), topic="/image", encoding="8UC1")]
    with open_recording(mcap_of(items)) as recording:
        assert not any("/image" in problem for problem in recording.problems)


def test_of_a_block_the_nearest_pixel_counts():
    depth = np.array([[0.0, 3.0, np.nan, 4.0, 9.0], [2.0, 5.0, 0.0, np.inf, 9.0], [1.0, 1.0, 1.0, 1.0, 9.0]])
    points = depth_points(depth, Intrinsics(2.0, 4.0, 0.0, 0.0), block=2)
    np.testing.assert_allclose(points, [[[0.0, 0.5, 2.0], [6.0, 0.0, 4.0]]])
    assert np.isnan(depth_points(np.zeros((2, 2)), CAMERA)).all()


def test_depth_images_are_converted_as_they_are(mcap_of, tmp_path):
    items = [bags.depth_image(0.1 * k, wall(2.0)) for k in range(3)]
    path = mcap_of([*items, bags.camera_info(0.0, CAMERA, SHAPE)])
    convert(path, tmp_path / "cut.mcap")
    with open_recording(path) as before, open_recording(tmp_path / "cut.mcap") as after:
        np.testing.assert_array_equal(before.sweep(2).points, after.sweep(2).points)
