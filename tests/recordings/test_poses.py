"""Recorded poses, TF chains, and the choice of the pose topic."""

import bags
import numpy as np
import pytest
from captures import laser_scan

from aero_viz.errors import UserError
from aero_viz.recordings import RecordedPoses, inspect, open_recording

LEVEL = np.array([1.0, 0, 0, 0])
YAW_90 = np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])


def poses(times, positions, quaternions=None, velocities=None):
    quaternions = np.tile(LEVEL, (len(times), 1)) if quaternions is None else quaternions
    return RecordedPoses(times, positions, quaternions, velocities)


def test_interpolation_between_two_poses():
    two = poses([0.0, 1.0], [[10, 0, 0], [12, 4, 0]], [LEVEL, YAW_90])
    pose = two.interpolate([0.0, 0.25, 1.0])
    np.testing.assert_allclose(pose.position, [[0, 0, 0], [0.5, 1, 0], [2, 4, 0]])
    half_angle = np.pi / 16  # of a quarter of 90 degrees
    np.testing.assert_allclose(pose.quaternion[1], [np.cos(half_angle), 0, 0, np.sin(half_angle)], atol=1e-12)


def test_attitude_follows_the_shortest_arc():
    two = poses([0.0, 1.0], np.zeros((2, 3)), [LEVEL, -YAW_90])
    half = two.interpolate(0.5).quaternion
    np.testing.assert_allclose(np.abs(half), [np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8)], atol=1e-12)


def test_positions_relative_to_the_first_keep_millimetres_in_float32():
    far = poses([0.0, 1.0], [[4.5e6, 5e5, 0], [4.5e6 + 0.001, 5e5, 0]])
    assert far.positions.astype(np.float32)[1, 0] == pytest.approx(0.001, rel=1e-3)
    np.testing.assert_array_equal(far.offset, [4.5e6, 5e5, 0])


def test_twist_is_rotated_from_the_body_to_the_world():
    turned = poses([0.0, 1.0], np.zeros((2, 3)), [YAW_90, YAW_90], [[3, 0, 1], [3, 0, 1]])
    assert turned.measured_velocity
    np.testing.assert_allclose(turned.velocities, [[0, 3, 1], [0, 3, 1]], atol=1e-12)


@pytest.mark.parametrize("twist", [None, np.zeros((21, 3)), np.full((21, 3), np.nan)])
def test_velocity_from_positions_without_a_twist(twist):
    t = np.linspace(0, 2, 21)
    derived = poses(t, np.stack([t**2, 3 * t, 0 * t], axis=1), None, twist)
    assert not derived.measured_velocity
    np.testing.assert_allclose(derived.velocities[1:-1], np.stack([2 * t, 3 + 0 * t, 0 * t], 1)[1:-1], atol=1e-9)


def test_poses_are_sorted_and_the_last_of_equal_times_is_used():
    shuffled = poses([0.2, 0.0, 0.1, 0.1], [[2, 0, 0], [0, 0, 0], [9, 9, 9], [1, 0, 0]])
    np.testing.assert_array_equal(shuffled.times, [0.0, 0.1, 0.2])
    np.testing.assert_array_equal(shuffled.positions[:, 0], [0, 1, 2])


def test_extrapolation_ends_at_the_tolerance():
    two = poses([0.0, 0.5], [[0, 0, 0], [1, 0, 0]])
    np.testing.assert_allclose(two.interpolate(0.59).position, [1.18, 0, 0])
    np.testing.assert_array_equal(two.covers([-0.11, -0.09, 0.3, 0.59, 0.61]), [False, True, True, True, False])
    with pytest.raises(ValueError, match="no recorded pose"):
        two.interpolate(0.61)


def test_long_gaps_are_not_interpolated():
    gap = poses([0.0, 0.1, 0.2, 5.0, 5.1], np.zeros((5, 3)))
    np.testing.assert_array_equal(gap.covers([0.15, 0.25, 2.0, 4.95, 5.05]), [True, True, False, True, True])


def test_tf_chain_with_a_static_extrinsic(written):
    items = [
        bags.transform(0, "base_link", "lidar", [0.1, 0, 0.2], YAW_90, topic="/tf_static"),
        bags.transform(0, "map", "odom", [10, 0, 0], YAW_90),
        *(bags.transform(0.05 * k, "odom", "base_link", [0.1 * k, 0, 0]) for k in range(21)),
        *(bags.cloud(0.1 * k, bags.xyz([[1.0, 0, 0]])) for k in range(11)),
    ]
    with open_recording(written(sorted(items, key=lambda item: item.time))) as recording:
        assert recording.pose_topic == "/tf" and recording.poses is not None and recording.problems == []
        # The LiDAR faces the left of the body, and the cloud is in the body's frame.
        np.testing.assert_allclose(recording.sweep(0).points, [[0.1, 1.0, 0.2]], atol=1e-6)
        np.testing.assert_allclose(recording.poses.offset, [10, 0, 0], atol=1e-9)
        pose = recording.poses.interpolate(0.5)
        np.testing.assert_allclose(pose.position, [0, 1, 0], atol=1e-6)
        np.testing.assert_allclose(pose.quaternion, YAW_90, atol=1e-9)
        np.testing.assert_allclose(pose.velocity, [0, 2, 0], atol=1e-6)


def test_odometry_of_another_frame_uses_the_static_transform(mcap_of):
    static = [
        bags.transform(0, "base", "mast", [0, 0, 1], topic="/tf_static"),
        bags.transform(0, "mast", "lidar", [0, 0, 0.5], YAW_90, topic="/tf_static"),
    ]
    with open_recording(mcap_of([*static, *bags.drive(child="base")])) as recording:
        expected = bags.wall()[:, [1, 0, 2]] * [-1, 1, 1] + [0, 0, 1.5]
        np.testing.assert_allclose(recording.sweep(0).points, expected, atol=1e-5)
        assert recording.problems == []


def test_poses_without_a_frame_are_those_of_the_body_that_carries_the_sensor(mcap_of):
    items = [bags.transform(0, "base", "lidar", [0, 0, 1], YAW_90, topic="/tf_static")]
    items += [bags.pose_stamped(0.1 * k, [k, 0, 0]) for k in range(10)]
    items += [bags.cloud(0.1 * k, bags.xyz(bags.wall())) for k in range(10)]
    with open_recording(mcap_of(items)) as recording:
        expected = bags.wall()[:, [1, 0, 2]] * [-1, 1, 1] + [0, 0, 1]
        np.testing.assert_allclose(recording.sweep(0).points, expected, atol=1e-5)
        assert any("taken for those of 'base'" in problem for problem in recording.problems)


@pytest.mark.parametrize("is_joined", [True, False])
def test_every_sweep_has_the_mounting_of_its_own_frame(mcap_of, is_joined):
    items = [bags.transform(0, "base", "left", [0, 0, 1], topic="/tf_static")]
    items += [bags.transform(0, "base", "right", [0, 0, 2], YAW_90, topic="/tf_static")] if is_joined else []
    items += [bags.odometry(0.1 * k, [k, 0, 0], child="base") for k in range(10)]
    items += [bags.cloud(0.1 * k, bags.xyz(bags.wall()), frame=("left", "right")[k % 2]) for k in range(10)]
    with open_recording(mcap_of(items)) as recording:
        np.testing.assert_allclose(recording.sweep(0).points, np.add(bags.wall(), [0, 0, 1]), atol=1e-5)
        turned = bags.wall()[:, [1, 0, 2]] * [-1, 1, 1] + [0, 0, 2]
        right = turned if is_joined else np.add(bags.wall(), [0, 0, 1])
        np.testing.assert_allclose(recording.sweep(1).points, right, atol=1e-5)
        assert len(recording.sweep_times) == (10 if is_joined else 5)
        said = any("of 2 sensors, left (" in text and "--sensor plays right (" in text for text in recording.problems)
        assert said != is_joined


def test_unknown_extrinsic_is_reported(mcap_of):
    problems = inspect(mcap_of(bags.drive(child="base_link"))).problems
    assert any("'base_link'" in problem and "'lidar'" in problem for problem in problems)


def test_odometry_is_preferred_unless_a_topic_is_named(mcap_of):
    path = mcap_of([*bags.drive(), *(bags.pose_stamped(0.01 * k, [0, k, 0]) for k in range(100))])
    assert inspect(path).pose_topic == "/odom"
    info = inspect(path, pose_topic="/pose")
    assert info.pose_topic == "/pose" and info.poses == 100


def test_poses_whose_frame_is_joined_to_the_clouds_are_preferred(mcap_of):
    static = bags.transform(0, "base", "lidar", [0, 0, 1], topic="/tf_static")
    wheels = [bags.odometry(0.01 * k, [0, 0, 0], topic="/wheels", child="wheels") for k in range(100)]
    assert inspect(mcap_of([static, *wheels, *bags.drive(child="base")])).pose_topic == "/odom"
    moved = [bags.transform(0.1 * k, "odom", "base", [k, 0, 0]) for k in range(10)]
    assert inspect(mcap_of([static, *moved, *bags.drive(child="footprint")])).pose_topic == "/tf"


def test_a_named_topic_without_poses_is_refused(mcap_of):
    unset = [bags.odometry(0.1 * k, [0, 0, 0], wxyz=(0, 0, 0, 0), topic="/unset") for k in range(10)]
    with pytest.raises(UserError, match=r"/unset of .* has no pose that can be used"):
        open_recording(mcap_of([*bags.drive(), *unset]), pose_topic="/unset")


def test_poses_of_two_robots_on_one_topic_are_not_mixed(mcap_of):
    others = [bags.odometry(0.05 * k + 0.001, [0, 50, 0], child="robot2") for k in range(40)]
    with open_recording(mcap_of([*bags.drive(), *others])) as recording:
        assert recording.poses is not None and len(recording.poses.times) == 37
        assert np.ptp(recording.poses.positions[:, 1]) == 0.0
        assert any("37 of 77, those of 'lidar' in 'odom', are used" in problem for problem in recording.problems)


def test_topic_of_other_times_is_not_used_for_the_poses(mcap_of):
    items = [bags.cloud(0.1 * k, bags.xyz(bags.wall())) for k in range(10)]
    items += [bags.odometry(60.0, [0, 0, 0], topic="/odom_of_another_day")]
    items += [bags.pose_stamped(0.1 * k, [k, 0, 0]) for k in range(10)]
    assert inspect(mcap_of(items)).pose_topic == "/pose"


def test_uncovered_sweeps_are_left_out_and_reported(mcap_of):
    items = [item for item in bags.drive() if item.topic == "/points" or item.time >= bags.START + 0.4e9]
    path = mcap_of(items)
    info = inspect(path)
    # The first pose is at 0.4 s and is extrapolated back to 0.3 s.
    assert info.sweeps == 7 and "no pose covers sweeps 0..2 of 10" in info.problems
    with open_recording(path) as recording:
        assert recording.sweep_times[0] == 0.0 and recording.poses is not None
        assert recording.poses.times[0] == pytest.approx(0.1)


def test_different_clocks_fall_back_to_the_time_of_recording(mcap_of):
    items = [bags.cloud(0.1 * k, bags.xyz(bags.wall()), late=1000.0) for k in range(10)]
    items += [bags.odometry(1000 + 0.1 * k, [k, 0, 0]) for k in range(10)]
    info = inspect(mcap_of(items))
    assert info.sweeps == 10 and any("different clocks" in problem for problem in info.problems)


@pytest.mark.parametrize(
    ("stamps", "text"),
    [
        ([0.1 * k - 2.0 * (k >= 10) for k in range(20)], "stamps step back by 1.9 s at sweep 10"),
        ([0.1 * k + 3600.0 * (k >= 10) for k in range(20)], "stamps step ahead by 3600.0 s at sweep 10"),
        ([0.1 * k - 1.69e9 * (k == 0) for k in range(20)], "stamps step ahead by 1690000000.0 s at sweep 1"),
        ([0.0] * 20, "the stamps of all sweeps are equal"),
    ],
)
def test_a_clock_that_is_set_is_noticed_and_the_times_of_recording_are_used(mcap_of, stamps, text):
    items = [bags.cloud(t, bags.xyz(bags.wall(seed=k)), late=0.1 * k - t) for k, t in enumerate(stamps)]
    items += [bags.odometry(t, [k, 0, 0], late=0.1 * k - t) for k, t in enumerate(stamps)]
    with open_recording(mcap_of(items)) as recording:
        assert any(f"{text}; times of recording are used" in problem for problem in recording.problems)
        np.testing.assert_allclose(recording.sweep_times, 0.1 * np.arange(20), atol=1e-6)
        assert recording.poses is not None
        np.testing.assert_allclose(recording.poses.interpolate(1.55).position, [15.5, 0, 0], atol=1e-5)
        np.testing.assert_array_equal(recording.sweep(15).points, bags.wall(seed=15).astype(np.float32))


def test_late_sweeps_and_pauses_are_not_faults_of_the_clock(mcap_of):
    times = [0.1 * k + 60.0 * (k >= 10) for k in range(20)]
    items = [bags.cloud(t, bags.xyz(bags.wall()), late=3.0 * (k == 5)) for k, t in enumerate(times)]
    assert not any("step" in problem for problem in inspect(mcap_of(items)).problems)


def test_poses_of_another_time_are_an_error(mcap_of):
    items = [bags.cloud(0.1 * k, bags.xyz(bags.wall())) for k in range(3)]
    path = mcap_of([*items, bags.odometry(60, [0, 0, 0]), bags.odometry(61, [0, 0, 0])])
    with pytest.raises(UserError, match=r"/odom .* do not overlap the sweeps"):
        open_recording(path)
    assert inspect(path).sweeps == 0


def test_unset_quaternions_are_left_out(mcap_of):
    items = [*bags.drive(), bags.odometry(0.512, [0, 0, 0], wxyz=(0, 0, 0, 0))]
    info = inspect(mcap_of(items))
    assert info.poses == 37
    assert any("1 of 38 messages on /odom" in problem for problem in info.problems)


def registered(topic="/cloud_registered"):
    """Return what FAST-LIO publishes: clouds in the frame of the world, and the pose of the body in it."""
    items = [bags.odometry(0.1 * k, [0.5 * k, 0, 0], parent="camera_init", child="body") for k in range(10)]
    items += [bags.cloud(0.1 * k, bags.xyz(bags.wall()), frame="camera_init", topic=topic) for k in range(10)]
    return items


def test_clouds_in_the_frame_of_the_world_are_moved_to_the_body(mcap_of):
    with open_recording(mcap_of(registered())) as recording:
        for k in (0, 7):
            np.testing.assert_allclose(recording.sweep(k).points, bags.wall() - [0.5 * k, 0, 0], atol=1e-5)
        assert any("frame of the world, 'camera_init'" in problem for problem in recording.problems)


def test_clouds_in_map_coordinates_are_moved_to_the_body_without_loss(mcap_of):
    place = np.array([500_000.0, 5_400_000.0, 100.0])
    items = [bags.odometry(0.1 * k, np.add(place, [0.5 * k, 0, 0]), parent="map", child="base") for k in range(10)]
    items += [bags.cloud(0.1 * k, bags.xyz(place + bags.wall(), "f8"), frame="map") for k in range(10)]
    with open_recording(mcap_of(items)) as recording:
        np.testing.assert_allclose(recording.sweep(7).points, bags.wall() - [3.5, 0, 0], atol=1e-5)


@pytest.mark.parametrize("frame", ["map", "odom"])
def test_transforms_move_clouds_in_the_frame_of_the_world_to_the_body(mcap_of, frame):
    items = [bags.transform(0.02 * k, "odom", "base", [0.1 * k, 0, 0]) for k in range(60)]
    items += [bags.transform(0.1 * k, "map", "odom", [0, 1 + 0.1 * k, 0]) for k in range(12)]
    items += [bags.cloud(0.1 * k, bags.xyz(bags.wall()), frame=frame) for k in range(10)]
    with open_recording(mcap_of(items)) as recording:
        assert recording.pose_topic == "/tf" and len(recording.sweep_times) == 10
        moved = [2.5, 1.5 if frame == "map" else 0.0, 0]
        np.testing.assert_allclose(recording.sweep(5).points, bags.wall() - moved, atol=1e-5)
        assert any(f"frame of the world, '{frame}'" in problem for problem in recording.problems)


def test_transforms_that_do_not_lead_to_the_clouds_are_named(mcap_of):
    items = [bags.transform(0.1 * k, "odom", "base", [k, 0, 0]) for k in range(10)]
    problems = inspect(mcap_of([*items, bags.cloud(0, bags.xyz(bags.wall()))])).problems
    assert any("TF moves 'base', but no transforms join that to 'lidar'" in problem for problem in problems)


def test_clouds_of_the_sensor_are_preferred_to_registered_ones_and_to_planar_scans(mcap_of):
    sensor = [bags.cloud(0.1 * k, bags.xyz(bags.wall()), topic="/livox") for k in range(9)]
    scans = [laser_scan(0.02 * k) for k in range(40)]
    assert inspect(mcap_of([*registered(), *sensor, *scans])).points_topic == "/livox"
    assert inspect(mcap_of([*registered(), *sensor]), points_topic="/cloud_registered").sweeps == 10
