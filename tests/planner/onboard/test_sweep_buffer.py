"""Deskewing against a float64 reference, ages, waiting and dropped points, and bounded memory."""

import math
import threading

import numpy as np
import pytest

from aero_planner.onboard.sweep_buffer import SweepBuffer
from aero_planner.quaternions import conjugate, multiply, quaternion_from_angles, rotate

LEVEL = (1.0, 0.0, 0.0, 0.0)


def cloud_of(buffer, now):
    """Return the joined cloud and its age."""
    sweeps, age = buffer.cloud(now)
    return sweeps.points, age


def pose(time):
    """Return the pose of a flight with turns about all axes."""
    position = np.array([5.0 * time, math.sin(3.0 * time), 2.0 + 0.3 * math.cos(2.0 * time)])
    turn = quaternion_from_angles(25.0 * math.sin(4.0 * time), 20.0 * math.cos(3.0 * time), 90.0 * time)
    return position, turn


def slerp(a, b, share):
    """Return exp(share log(b a^-1)) a, along the shorter arc."""
    turn = multiply(b, conjugate(a))
    turn = turn if turn[0] >= 0.0 else -turn
    sine = np.linalg.norm(turn[1:])
    angle = share * math.atan2(sine, turn[0])
    axis = turn[1:] / sine if sine > 0.0 else np.zeros(3)
    return multiply([math.cos(angle), *(math.sin(angle) * axis)], a)


def placed(point, time, poses):
    """Return the point in the world frame from the two poses around its time."""
    times = [entry[0] for entry in poses]
    i = min(max(int(np.searchsorted(times, time)) - 1, 0), len(poses) - 2)
    (t0, p0, q0), (t1, p1, q1) = poses[i], poses[i + 1]
    share = (time - t0) / (t1 - t0)
    return (1.0 - share) * p0 + share * p1 + rotate(slerp(q0, q1, share), point)


@pytest.mark.parametrize("mounted", [False, True])
def test_points_are_placed_by_the_pose_at_their_time(mounted):
    random = np.random.default_rng(0)
    place, turn = ([0.1, -0.05, 0.2], quaternion_from_angles(180.0, 20.0, 5.0)) if mounted else ([0, 0, 0], LEVEL)
    buffer = SweepBuffer(mount_position=place, mount_quaternion=turn)
    poses = [(100.0 + t, *pose(t)) for t in np.arange(0.0, 0.5, 0.02)]
    for i, (time, position, quaternion) in enumerate(poses):
        buffer.add_pose(time, position, quaternion if i % 3 else -quaternion)  # both signs are the same attitude
    points = random.uniform(-20.0, 20.0, size=(300, 3)).astype(np.float32)
    times = random.uniform(100.0, 100.48, size=300)
    buffer.add_points(points, times)
    cloud, age = cloud_of(buffer, 100.6)
    assert cloud.dtype == np.float32
    in_body = rotate(turn, points.astype(float)) + place
    expected = [placed(point, time, poses) for point, time in zip(in_body, times, strict=True)]
    np.testing.assert_allclose(cloud, expected, atol=2e-5)
    assert age == pytest.approx(100.6 - times.max())
    assert buffer.dropped == 0


def test_a_still_wall_stays_still_from_a_turning_drone():
    # Without deskewing, 3 rad/s and 5 m/s would smear this wall by half a metre.
    buffer = SweepBuffer()
    random = np.random.default_rng(1)
    times = np.sort(random.uniform(0.0, 0.5, size=5000))
    wall = np.column_stack([np.full(5000, 12.0), random.uniform(-5, 5, 5000), random.uniform(0, 4, 5000)])
    states = [(5.0 * t * np.array([1.0, 0.2, 0.0]), quaternion_from_angles(0, 0, math.degrees(3.0 * t))) for t in times]
    seen = [rotate(conjugate(q), point - p) for point, (p, q) in zip(wall, states, strict=True)]
    buffer.add_points(seen, times)
    for t in np.arange(0.0, 0.52, 0.02):
        buffer.add_pose(t, 5.0 * t * np.array([1.0, 0.2, 0.0]), quaternion_from_angles(0, 0, math.degrees(3.0 * t)))
    cloud, _ = cloud_of(buffer, 0.5)
    assert len(cloud) == 5000
    assert np.abs(cloud[:, 0] - 12.0).max() < 1e-4


def test_new_points_wait_for_the_next_pose():
    buffer = SweepBuffer()
    buffer.add_points([[1.0, 0.0, 0.0]] * 3, [0.01, 0.02, 0.03])
    assert len(cloud_of(buffer, 0.0)[0]) == 0
    buffer.add_pose(0.0, (0, 0, 0), LEVEL)
    assert len(cloud_of(buffer, 0.0)[0]) == 0
    buffer.add_pose(0.02, (2, 0, 0), LEVEL)
    np.testing.assert_allclose(cloud_of(buffer, 0.0)[0], [[2.0, 0, 0], [3.0, 0, 0]])
    buffer.add_pose(0.04, (2, 4, 0), LEVEL)
    np.testing.assert_allclose(cloud_of(buffer, 0.0)[0][2], [3.0, 2.0, 0.0], atol=1e-6)
    assert buffer.dropped == 0


def test_a_cleared_buffer_discards_poses_and_points():
    buffer = SweepBuffer()
    for t in (10.0, 10.02):
        buffer.add_pose(t, (0, 0, 0), LEVEL)
    buffer.add_points([[1.0, 0.0, 0.0]] * 3, [10.0, 10.01, 10.03])
    buffer.clear()
    points, age = cloud_of(buffer, 10.04)
    assert len(points) == 0 and age == math.inf and buffer.dropped == 1  # the point that waited
    # Points between the last pose before and the first pose after the reset can't be placed.
    buffer.add_points([[1.0, 0.0, 0.0]] * 2, [10.03, 10.05])
    buffer.add_pose(10.04, (5, 0, 0), LEVEL)
    buffer.add_pose(10.06, (5, 0, 0), LEVEL)
    np.testing.assert_allclose(cloud_of(buffer, 10.06)[0], [[6.0, 0.0, 0.0]])
    assert buffer.dropped == 2


def test_points_from_before_the_first_pose_are_dropped_and_counted():
    buffer = SweepBuffer()
    for t in (10.0, 10.02):
        buffer.add_pose(t, (0, 0, 0), LEVEL)
    buffer.add_points([[1.0, 0.0, 0.0]] * 4, [9.0, 9.999, 10.0, 10.01])
    assert len(cloud_of(buffer, 10.0)[0]) == 2
    assert buffer.dropped == 2


def test_points_between_distant_poses_are_dropped_and_counted():
    buffer = SweepBuffer(max_gap=0.25)
    for t in (0.0, 0.02, 1.02, 1.04):
        buffer.add_pose(t, (0, 0, 0), LEVEL)
    buffer.add_points([[1.0, 0.0, 0.0]] * 3, [0.01, 0.5, 1.03])
    assert len(cloud_of(buffer, 1.0)[0]) == 2
    assert buffer.dropped == 1


def test_one_pose_places_points_measured_at_its_time():
    buffer = SweepBuffer()
    buffer.add_pose(5.0, (1, 2, 3), LEVEL)
    buffer.add_points([[1.0, 0.0, 0.0]] * 2, [4.0, 5.0])
    np.testing.assert_allclose(cloud_of(buffer, 5.0)[0], [[2.0, 2.0, 3.0]])
    assert buffer.dropped == 1


def test_the_cloud_holds_the_last_sweeps():
    buffer = SweepBuffer(sweeps=5, period=0.1)
    for k in range(100):
        buffer.add_pose(0.02 * k, (0, 0, 0), LEVEL)
        buffer.add_points(np.full((10, 3), k), np.full(10, 0.02 * k))
    cloud, age = cloud_of(buffer, 2.0)
    # Half a second before the newest points at 1.98 s.
    assert (cloud[:, 0].min(), cloud[:, 0].max()) == (74, 99)
    assert age == pytest.approx(0.02)


def test_older_sweeps_are_thinned_and_then_forgotten():
    buffer, random = SweepBuffer(sweeps=5, period=0.1, older_sweeps=10), np.random.default_rng(0)
    for k in range(100):
        points = random.uniform(-1.0, 1.0, (100, 3)).astype(np.float32)
        points[:, 0] = k
        buffer.add_pose(0.02 * k, (0, 0, 0), LEVEL)
        buffer.add_points(points, np.full(100, 0.02 * k))
        if k % 3 == 0:
            buffer.cloud(0.02 * k)
    counts = np.bincount(cloud_of(buffer, 2.0)[0][:, 0].astype(int), minlength=100)
    assert np.all(counts[74:] == 100)
    assert np.all(counts[24:74] > 0) and 0.15 < counts[24:74].mean() / 100 < 0.25
    assert not counts[:22].any()  # three ticks form a sweep


def test_ages():
    buffer = SweepBuffer()
    assert cloud_of(buffer, 7.0)[1] == math.inf
    assert cloud_of(buffer, 7.0)[0].shape == (0, 3)
    for t in (6.0, 6.02):
        buffer.add_pose(t, (0, 0, 0), LEVEL)
    buffer.add_points([[1.0, 0.0, 0.0]], [6.01])
    assert cloud_of(buffer, 7.0)[1] == pytest.approx(0.99)
    buffer.add_points([[1.0, 0.0, 0.0]], [6.005])  # late: the newest point stays the newest
    assert cloud_of(buffer, 7.0)[1] == pytest.approx(0.99)


def test_poses_that_are_not_newer_are_ignored():
    buffer = SweepBuffer()
    for t, x in ((0.0, 0.0), (0.02, 2.0), (0.02, 9.0), (0.01, 9.0), (math.nan, 9.0)):
        buffer.add_pose(t, (x, 0, 0), LEVEL)
    buffer.add_points([[0.0, 0.0, 0.0]], [0.01])
    np.testing.assert_allclose(cloud_of(buffer, 0.0)[0], [[1.0, 0, 0]])


def test_memory_is_bounded_while_poses_are_missing():
    buffer = SweepBuffer(capacity=1000)
    for k in range(100):
        buffer.add_points(np.ones((90, 3)), np.full(90, 0.01 * k))
    assert buffer.dropped >= 9000 - 1000
    buffer.add_points(np.ones((5000, 3)), np.full(5000, 2.0))
    buffer.add_pose(1.0, (0, 0, 0), LEVEL)
    buffer.add_pose(3.0, (0, 0, 0), LEVEL)
    assert len(cloud_of(buffer, 0.0)[0]) + buffer.dropped == 14_000
    assert buffer.waiting == 0


@pytest.mark.parametrize(("older", "most"), [(0, 1000), (20, 1500)])
def test_memory_is_bounded_while_points_pour_in(older: int, most: int):
    buffer = SweepBuffer(capacity=1000, older_sweeps=older)
    for k in range(1000):
        buffer.add_pose(0.001 * k, (0, 0, 0), LEVEL)
        buffer.add_points(np.full((70, 3), k), np.full(70, 0.001 * k))
    cloud, _ = cloud_of(buffer, 1.0)
    assert most - 600 < len(cloud) <= most
    assert cloud[-1, 0] == 999
    assert len(np.unique(cloud[:, 0])) < 45  # calls of add_points that are still held


def test_hours_of_poses_fit():
    buffer = SweepBuffer()
    for k in range(5000):
        buffer.add_pose(0.01 * k, (0.01 * k, 0, 0), LEVEL)
    buffer.add_points([[0.0, 0.0, 0.0]] * 2, [49.985, 46.005])
    np.testing.assert_allclose(cloud_of(buffer, 50.0)[0][:, 0], [49.985, 46.005], atol=1e-4)
    buffer.add_points([[0.0, 0.0, 0.0]], [40.0])
    assert buffer.dropped == 1


def test_it_is_thread_safe():
    buffer = SweepBuffer(capacity=50_000)
    failures = []

    def look():
        try:
            for _ in range(300):
                cloud, _ = cloud_of(buffer, 7.0)
                assert np.isfinite(cloud).all()
        except Exception as error:
            failures.append(error)

    reader = threading.Thread(target=look)
    reader.start()
    for k in range(300):
        buffer.add_pose(0.02 * k, (0, 0, 0), LEVEL)
        buffer.add_points(np.ones((400, 3)), 0.02 * k - 0.02 + np.arange(400) * 5e-5)
    reader.join()
    assert failures == []


@pytest.mark.parametrize("option", [{"sweeps": 0}, {"period": -1.0}, {"capacity": 0}, {"max_gap": math.nan}])
def test_options_out_of_range(option):
    with pytest.raises(ValueError, match=next(iter(option))):
        SweepBuffer(**option)
