"""Poses over time: interpolation and deskewing against a float64 reference, and the bounds of the track."""

import math

import numpy as np
import pytest

from aero_planner.pose_track import PoseTrack
from aero_planner.quaternions import quaternion_from_angles, rotate, rotation_matrix, slerp

LEVEL = (1.0, 0.0, 0.0, 0.0)


def flight(count, *, dt=0.02):
    """Times [count], positions [count, 3] and attitudes [count, 4] of a flight with turns about all axes."""
    times = dt * np.arange(count)
    positions = np.column_stack([5.0 * times, np.sin(3.0 * times), 2.0 + 0.3 * np.cos(2.0 * times)])
    angles = [(25.0 * math.sin(4.0 * t), 20.0 * math.cos(3.0 * t), 90.0 * t) for t in times]
    return times, positions, np.array([quaternion_from_angles(*each) for each in angles])


def appended(times, positions, quaternions, capacity=512):
    track = PoseTrack(capacity)
    for pose in zip(times, positions, quaternions, strict=True):
        assert track.append(*pose)
    return track


def test_a_track_from_arrays_equals_an_appended_one():
    times, positions, quaternions = flight(30)
    quaternions = quaternions * np.random.default_rng(0).choice([-1.0, 1.0], size=(30, 1))
    whole, grown = PoseTrack.from_arrays(times, positions, quaternions), appended(times, positions, quaternions)
    assert len(whole) == len(grown) == 30
    for name in ("times", "positions", "quaternions", "newest_time"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(grown, name))
    assert (np.sum(whole.quaternions[:-1] * whole.quaternions[1:], axis=1) > 0.0).all()


def test_the_oldest_poses_are_dropped():
    times, positions, quaternions = flight(1000)
    track = appended(times, positions, quaternions, capacity=64)
    np.testing.assert_array_equal(track.times, times[-64:])
    np.testing.assert_array_equal(track.positions, positions[-64:])


@pytest.mark.parametrize("time", [0.02, 0.01, math.nan])
def test_poses_that_are_not_newer_are_refused(time):
    track = appended([0.0, 0.02], [(0, 0, 0), (2, 0, 0)], [LEVEL, LEVEL])
    assert not track.append(time, (9, 0, 0), LEVEL)
    np.testing.assert_array_equal(track.positions[:, 0], [0, 2])


def test_interpolation_is_linear_and_along_the_shortest_arc():
    times, positions, quaternions = flight(10)
    track = PoseTrack.from_arrays(times, positions, quaternions)
    position, quaternion = track.interpolate([0.045, 0.06])
    np.testing.assert_allclose(position[0], 0.75 * positions[2] + 0.25 * positions[3])
    np.testing.assert_allclose(quaternion[0], slerp(quaternions[2], quaternions[3], 0.25))
    np.testing.assert_allclose(position[1], positions[3])
    single, _ = track.interpolate(0.045)
    np.testing.assert_array_equal(single, position[0])


def test_interpolation_holds_the_ends():
    track = PoseTrack.from_arrays(
        [1.0, 2.0], [(1, 0, 0), (2, 0, 0)], np.stack([LEVEL, quaternion_from_angles(0, 0, 90)])
    )
    position, quaternion = track.interpolate([0.0, 9.0])
    np.testing.assert_allclose(position[:, 0], [1.0, 2.0])
    np.testing.assert_allclose(rotate(quaternion, [1.0, 0, 0]), [[1, 0, 0], [0, 1, 0]], atol=1e-12)


def test_an_empty_track():
    track = PoseTrack()
    assert len(track) == 0 and track.newest_time == -math.inf
    with pytest.raises(ValueError, match="no pose"):
        track.interpolate(0.0)
    _, known = track.deskew(np.ones((3, 3), np.float32), np.zeros(3))
    assert not known.any()


@pytest.mark.parametrize("mounted", [False, True])
def test_deskewing_moves_each_point_by_the_pose_at_its_time(mounted):
    random = np.random.default_rng(1)
    track = PoseTrack.from_arrays(*flight(25))
    points = random.uniform(-20.0, 20.0, size=(300, 3)).astype(np.float32)
    times = random.uniform(0.0, 0.48, size=300)
    in_body, mount = points.astype(float), None
    if mounted:
        sensor, place = quaternion_from_angles(180.0, 20.0, 5.0), np.array([0.1, -0.05, 0.2])
        mount = np.column_stack([rotation_matrix(sensor), place]).astype(np.float32)
        in_body = rotate(sensor, in_body) + place
    cloud, known = track.deskew(points, times, mount=mount)
    position, quaternion = track.interpolate(times)
    assert cloud.dtype == np.float32 and known.all()
    np.testing.assert_allclose(cloud, rotate(quaternion, in_body) + position, atol=2e-5)


def test_points_outside_the_track_and_in_long_gaps_have_no_pose():
    times = [0.0, 0.1, 0.5, 0.6]
    track = PoseTrack.from_arrays(times, np.zeros((4, 3)), np.tile(LEVEL, (4, 1)))
    seen = np.array([-0.01, 0.0, 0.05, 0.1, 0.3, 0.55, 0.6, 0.61, math.nan])
    _, known = track.deskew(np.ones((len(seen), 3), np.float32), seen, max_gap=0.2)
    np.testing.assert_array_equal(known, [False, True, True, True, False, True, True, False, False])
