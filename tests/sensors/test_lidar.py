import dataclasses
from itertools import pairwise

import numpy as np
import pytest
import warp as wp

from aero_viz.errors import UserError
from aero_viz.scenes import World
from aero_viz.scenes.device_worlds import DeviceWorlds
from aero_viz.sensors import LIDARS, Lidar, LidarModel, lidar_model

MID360, FULL_SPHERE, SPINNING64 = (LIDARS[name] for name in ("mid360", "full-sphere", "spinning64"))
RADIUS = 10.0
LEVEL = (1.0, 0.0, 0.0, 0.0)


@pytest.fixture
def shell() -> World:
    """Return a world of six walls 10 m from the origin, in which every ray has a return."""
    faces = [[s * 15.0 * (k == i) for k in range(3)] for i in range(3) for s in (-1, 1)]
    return World(
        "", np.zeros(3), np.ones(3), boxes=np.array([[*c, *[10.0 if v else 60.0 for v in c], 0.0] for c in faces])
    )


def sweep(model, world, *, number=0, seeds=(0,), position=(0, 0, 0), before=None, quaternion=LEVEL):
    worlds = DeviceWorlds([world] * len(seeds))
    lidar = Lidar(model, worlds, seeds=seeds)
    count = len(seeds)
    poses = wp.array([position] * count, dtype=wp.vec3), wp.array([quaternion] * count, dtype=wp.vec4)
    earlier = wp.array([before or position] * count, dtype=wp.vec3), poses[1]
    active = wp.ones(count, dtype=int)
    lidar.scan(number, 0, model.points_per_sweep, poses=poses, poses_before=earlier, active=active)
    return lidar.points.numpy()


def exact(model, **changes):
    return dataclasses.replace(model, range_noise=0.0, dropout=0.0, **changes)


def directions(points):
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def coverage(points):
    """Return the fraction of the 3 deg cells in the field of view of a Mid-360 that hold a point."""
    d = directions(points)
    elevation = np.degrees(np.arcsin(np.clip(d[:, 2], -1.0, 1.0)))
    azimuth = np.degrees(np.arctan2(d[:, 1], d[:, 0])) + 180.0
    cells = np.floor(azimuth / 3.0).astype(int) % 120 * 60 + np.floor((elevation + 7.0) / 3.0).astype(int)
    return len(np.unique(cells[(elevation > -7.0) & (elevation < 50.0)])) / (120 * 19)


def test_triangles_out_of_sight_change_nothing(shell):
    """Worlds with triangles are scanned by a kernel of their own."""
    hidden = np.array([[100.0, 0.0, 0.0, 100.0, 1.0, 0.0, 100.0, 0.0, 1.0]])
    points = sweep(MID360, dataclasses.replace(shell, triangles=hidden))
    np.testing.assert_array_equal(points, sweep(MID360, shell))


def test_mid360_field_of_view_and_rate(shell):
    model = MID360
    assert model.points_per_sweep * model.sweep_rate == 200_000
    elevation = np.degrees(np.arcsin(directions(sweep(exact(model), shell)[0])[:, 2]))
    assert elevation.min() >= -7.01 and elevation.max() <= 52.01
    assert elevation.min() < -6.9 and elevation.max() > 51.9


def test_mid360_draws_tilted_rings_that_swing(shell):
    """Compare the pattern with its equation in float64, from the phase that the seed selects."""
    model = exact(MID360)
    d = directions(sweep(model, shell, number=3)[0].astype(float))
    azimuth, elevation = np.unwrap(np.arctan2(d[:, 1], d[:, 0])), np.degrees(np.arcsin(d[:, 2]))
    beams = [(azimuth[i::4], elevation[i::4]) for i in range(4)]
    time = np.arange(5000) / 50_000.0
    # All four beams look the same way at a time, turning 176.4 times a second; one of them is the first.
    for turned, _ in beams:
        np.testing.assert_allclose(np.diff(np.unwrap(turned)), 2 * np.pi * 176.4 / 50_000, atol=2e-5)
    wave = np.column_stack([np.cos(2 * np.pi * 10.016 * time), np.sin(2 * np.pi * 10.016 * time)])

    def misfit(first):
        """Largest distance to m + s cos(..) + w_i cos(azimuth) when beam `first` has w_0 [deg]."""
        worst = 0.0
        for i, tilt in enumerate((3.6, 1.2, -1.2, -3.6)):
            turned, seen = beams[(first + i) % 4]
            swing = seen - 22.5 - tilt * np.cos(turned)
            phase, *_ = np.linalg.lstsq(wave, swing, rcond=None)
            worst = max(worst, np.abs(wave @ phase - swing).max(), abs(np.hypot(*phase) - 25.9))
        return worst

    assert sorted(misfit(first) < 0.05 for first in range(4)) == [False, False, False, True]


def test_a_pattern_continues_from_sweep_to_sweep(shell):
    for model in (MID360, LidarModel("even", pattern="even")):
        long = sweep(exact(model, points_per_sweep=40_000, sweep_rate=5.0), shell, number=1)[0]
        short = [sweep(exact(model), shell, number=number)[0] for number in (2, 3)]
        np.testing.assert_allclose(long, np.concatenate(short), atol=2e-5)
        before = [sweep(exact(model), shell, number=number)[0] for number in (-1, 0)]
        assert not np.allclose(before[0], before[1], atol=1.0)


def test_full_sphere_is_uniform(shell):
    d = directions(sweep(exact(FULL_SPHERE), shell)[0])
    np.testing.assert_allclose(d.mean(axis=0), 0.0, atol=2e-3)
    np.testing.assert_allclose(d.T @ d / len(d), np.eye(3) / 3.0, atol=2e-3)


def test_spinning64_has_64_rings(shell):
    d = directions(sweep(exact(SPINNING64), shell)[0]).astype(float)
    rings = np.unique(np.round(np.degrees(np.arcsin(d[:, 2])), 2))
    assert len(rings) == 64 and rings[0] == -22.5 and rings[-1] == 22.5


def test_coverage_grows_from_sweep_to_sweep(shell):
    for model, least, most in ((MID360, 0.97, 0.99), (LidarModel("sparse", points_per_sweep=1000), 0.5, 0.99)):
        clouds = [sweep(exact(model), shell, number=number)[0] for number in range(10)]
        shares = [coverage(np.concatenate(clouds[:n])) for n in (1, 2, 5, 10)]
        assert shares[0] < least and shares[-1] > most
        assert shares[0] < shares[1] and all(b >= a for a, b in pairwise(shares))
    repeated = exact(SPINNING64, points_per_sweep=1024)
    np.testing.assert_allclose(sweep(repeated, shell, number=0), sweep(repeated, shell, number=7), atol=1e-5)


def test_range_noise_statistics():
    model = dataclasses.replace(FULL_SPHERE, range_noise=0.05, dropout=0.0)
    # The sensor is in a corner of nothing but one sphere, straight above: all rays that hit it come back radially.
    ball = World("", np.zeros(3), np.ones(3), spheres=np.array([[0.0, 0.0, 30.0, 25.0]]))
    noisy, clean = sweep(model, ball)[0], sweep(exact(model), ball)[0]
    hit = ~np.isnan(clean[:, 0])
    error = np.linalg.norm(noisy[hit], axis=1) - np.linalg.norm(clean[hit], axis=1)
    count = hit.sum()
    assert count > 4000
    assert abs(error.mean()) < 4 * 0.05 / np.sqrt(count)
    assert error.std() == pytest.approx(0.05, rel=4 / np.sqrt(2 * count))
    assert abs(np.mean(error**3)) / 0.05**3 < 4 * np.sqrt(15 / count)  # symmetric
    np.testing.assert_allclose(directions(noisy[hit]), directions(clean[hit]), atol=1e-5)  # along the ray only


def test_dropout_loses_its_fraction_of_the_returns(shell):
    lost = np.isnan(sweep(dataclasses.replace(FULL_SPHERE, dropout=0.25), shell)[0, :, 0]).mean()
    assert lost == pytest.approx(0.25, abs=4 * np.sqrt(0.25 * 0.75 / 20_000))


def test_stray_points_fill_a_ball_evenly_and_hide_what_lies_behind(shell):
    model = exact(FULL_SPHERE, strays=0.25, stray_range=2.0)
    ranges, clean = (np.linalg.norm(sweep(sensor, shell)[0], axis=1) for sensor in (model, exact(FULL_SPHERE)))
    is_stray = ranges < 0.9 * clean
    assert is_stray.mean() == pytest.approx(0.25, abs=4 * np.sqrt(0.25 * 0.75 / 20_000))
    shares = np.histogram(ranges[is_stray], bins=2.0 * np.linspace(0.0, 1.0, 6) ** (1.0 / 3.0))[0] / is_stray.sum()
    np.testing.assert_allclose(shares, 0.2, atol=0.03)
    others = ~is_stray & np.isfinite(ranges)  # a few are nearer than the sensor measures
    np.testing.assert_array_equal(ranges[others], clean[others])


def test_range_limits_leave_nan():
    world = World("", np.zeros(3), np.ones(3), spheres=np.array([[3.0, 0, 0, 1.0]]))
    assert np.isfinite(sweep(exact(FULL_SPHERE), world)).any()
    assert np.isnan(sweep(exact(FULL_SPHERE, range_max=1.9), world)).all()
    assert np.isnan(sweep(exact(FULL_SPHERE, range_min=3.0, range_max=9.0), world)).all()


def test_motion_within_a_sweep(shell):
    # The points lie on the walls, seen from a sensor that moves 1 m while it measures: no skew in the world frame.
    model = exact(FULL_SPHERE)
    points = sweep(model, shell, position=(1.0, 0.0, 0.0), before=(0.0, 0.0, 0.0))[0].astype(float)
    np.testing.assert_allclose(np.abs(points).max(axis=1), RADIUS, atol=1e-4)
    origin = (np.arange(model.points_per_sweep)[:, None] + 0.5) / model.points_per_sweep * [1.0, 0.0, 0.0]
    still = sweep(model, shell)[0].astype(float)
    np.testing.assert_allclose(directions(points - origin), directions(still), atol=1e-5)


def test_attitude_rotates_the_pattern(shell):
    # Yaw of 90 degrees: body x looks along world y.
    half = np.sqrt(0.5)
    model = exact(MID360)
    level = directions(sweep(model, shell)[0])
    turned = directions(sweep(model, shell, quaternion=(half, 0.0, 0.0, half))[0])
    np.testing.assert_allclose(turned, np.column_stack([-level[:, 1], level[:, 0], level[:, 2]]), atol=1e-5)


def test_mounting_angles_rotate_the_field_of_view(shell):
    # Upside down: what looked up to 52 degrees now looks down to -52.
    model = exact(MID360)
    upright, turned = (sweep(exact(model, mount_angles=angles), shell)[0] for angles in ((0, 0, 0), (180, 0, 0)))
    np.testing.assert_allclose(directions(turned), directions(upright) * [1, -1, -1], atol=1e-5)
    # Yaw after pitch: the sensor's x axis, pitched down by 30 degrees, then toward the left.
    ring = exact(SPINNING64, mount_angles=(0.0, 30.0, 90.0))
    first = directions(sweep(ring, shell)[0])[32::64][0]  # ring 32 of 64, near the horizon, at azimuth 0
    elevation = np.radians(-30.0 + (-22.5 + 32 * 45 / 63))
    np.testing.assert_allclose(first, [0.0, np.cos(elevation), np.sin(elevation)], atol=2e-3)


def test_mounting_position_moves_with_the_body(shell):
    model = exact(FULL_SPHERE, mount_position=(0.5, 0.0, 0.2))
    half = np.sqrt(0.5)
    mounted = sweep(model, shell, position=(1.0, 0.0, 0.0), quaternion=(half, 0.0, 0.0, half))
    # Yaw of 90 degrees: 0.5 m ahead is 0.5 m to the left.
    expected = sweep(exact(FULL_SPHERE), shell, position=(1.0, 0.5, 0.2), quaternion=(half, 0.0, 0.0, half))
    np.testing.assert_allclose(mounted, expected, atol=1e-4)


def test_points_are_placed_by_the_estimated_pose(shell):
    # The estimate is 1 m off and rotated by 90 degrees: the cloud is the true one, moved and rotated.
    model, half = exact(FULL_SPHERE), np.sqrt(0.5)
    worlds = DeviceWorlds([shell])
    lidar = Lidar(model, worlds, seeds=[0])
    true = wp.array([(0.0, 0.0, 0.0)], dtype=wp.vec3), wp.array([LEVEL], dtype=wp.vec4)
    estimated = wp.array([(0.0, 1.0, 0.0)], dtype=wp.vec3), wp.array([(half, 0.0, 0.0, half)], dtype=wp.vec4)
    options = {"poses": true, "poses_before": true, "active": wp.ones(1, dtype=int)}
    lidar.scan(0, 0, 20_000, estimated_poses=estimated, estimated_poses_before=estimated, **options)
    points = sweep(model, shell)[0]
    expected = np.column_stack([-points[:, 1], points[:, 0] + 1.0, points[:, 2]])
    np.testing.assert_allclose(lidar.points.numpy()[0], expected, atol=1e-4)


def test_points_depend_on_the_seed_and_not_on_the_batch(shell):
    model = MID360
    together = sweep(model, shell, seeds=(5, 6))
    np.testing.assert_array_equal(together[0], sweep(model, shell, seeds=(5,))[0])
    np.testing.assert_array_equal(together[1], sweep(model, shell, seeds=(6,))[0])
    assert not np.array_equal(together[0], together[1], equal_nan=True)


def test_inactive_sensors_measure_nothing(shell):
    lidar = Lidar(MID360, DeviceWorlds([shell]), seeds=[0])
    poses = wp.zeros(1, dtype=wp.vec3), wp.array([LEVEL], dtype=wp.vec4)
    lidar.scan(0, 0, 100, poses=poses, poses_before=poses, active=wp.zeros(1, dtype=int))
    assert np.isnan(lidar.points.numpy()).all()


def test_point_times_span_the_sweep():
    times = MID360.point_times()
    assert times.shape == (20_000,) and times[0] > 0.0 and times[-1] < 0.1
    np.testing.assert_allclose(np.diff(times), 5e-6)


@pytest.mark.parametrize(
    "changes",
    [
        {"points_per_sweep": 0},
        {"rings": 3, "pattern": "rings"},
        {"pattern": "spiral"},
        {"range_max": 0.05},
        {"dropout": 1.5},
        {"elevation_min": 60.0},
        {"mount_angles": (0.0, np.nan, 0.0)},
        {"mount_position": (0.0, 0.0)},
    ],
)
def test_invalid_models_are_refused(changes):
    with pytest.raises(ValueError, match=next(iter(changes))):
        LidarModel("odd", **changes)


def test_models_by_name():
    assert all(lidar_model(name).name == name for name in LIDARS)
    with pytest.raises(UserError, match=r"did you mean 'mid360'\?\); give one of mid360, "):
        lidar_model("mid36")


def test_points_lie_on_obstacles_where_they_are_at_the_time_of_the_ray():
    pole = np.array([[3.0, 0.0, -9.0, 0.0, 0.0, 1.0, 0.5, 20.0]])
    world = World("", np.zeros(3), np.ones(3), cylinders=pole, motion=np.array([[0.0, 2.0, 1.5]]))
    model = LidarModel("exact", points_per_sweep=2000, range_noise=0.0, dropout=0.0)
    lidar = Lidar(model, DeviceWorlds([world]), seeds=[3])
    pose = wp.zeros(1, dtype=wp.vec3), wp.array([(1.0, 0.0, 0.0, 0.0)], dtype=wp.vec4)
    active = wp.ones(1, dtype=int)
    for sweep in (-3, 0, 11):
        lidar.scan(sweep, 0, 1000, poses=pose, poses_before=pose, active=active)
        lidar.scan(sweep, 1000, 2000, poses=pose, poses_before=pose, active=active)
        points = lidar.points.numpy()[0]
        times = sweep * 0.1 + model.point_times()
        hits = np.flatnonzero(~np.isnan(points[:, 0]))
        y = 1.5 - np.abs(np.mod(2.0 * times[hits], 3.0) - 1.5)
        assert len(hits) > 50
        gap = np.hypot(points[hits, 0] - 3.0, points[hits, 1] - y) - 0.5
        np.testing.assert_allclose(gap, 0.0, atol=1e-4)
