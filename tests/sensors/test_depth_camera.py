"""Narrow fields of view, images of depth cameras, and several sensors on one drone."""

import dataclasses
from itertools import pairwise

import numpy as np
import pytest
import warp as wp

from aero_viz.errors import UserError
from aero_viz.scenes import World
from aero_viz.scenes.device_worlds import DeviceWorlds
from aero_viz.sensors import LIDARS, Lidar, LidarModel, coverage, lidar_model

D435 = LIDARS["d435"]
INSIDE = World("", np.zeros(3), np.ones(3), boxes=np.array([[*c, 4.0, 4.0, 4.0, 0.0] for c in
    [(4.0, 0, 0), (-4.0, 0, 0), (0, 4.0, 0), (0, -4.0, 0), (0, 0, 4.0), (0, 0, -4.0)]]))  # fmt: skip
"""Walls 2 m from the origin; every ray has a return."""


def exact(model, **changes):
    others = tuple(exact(other) for other in model.others)
    return dataclasses.replace(model, range_noise=0.0, dropout=0.0, others=others, **changes)


def directions(model, *, parts=1, sweep=0):
    """Return the directions of a sweep from the origin, measured in so many parts, shape [P, 3]."""
    lidar = Lidar(model, DeviceWorlds([INSIDE]), seeds=[5])
    poses = wp.zeros(1, dtype=wp.vec3), wp.array([(1.0, 0.0, 0.0, 0.0)], dtype=wp.vec4)
    ends = [part * model.rays_per_sweep // parts for part in range(parts + 1)]
    for first, end in pairwise(ends):
        lidar.scan(sweep, first, end, poses=poses, poses_before=poses, active=wp.ones(1, dtype=int))
    points = lidar.points.numpy()[0].astype(np.float64)
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def image(model):
    """Return the directions of the pixels of a camera, in float64, shape [rows * columns, 3]."""
    columns = model.points_per_sweep // model.rings
    y = np.tan(np.radians(model.azimuth_max)) * (1.0 - 2.0 * (np.arange(columns) + 0.5) / columns)
    z = np.tan(np.radians(model.elevation_max)) * (1.0 - 2.0 * (np.arange(model.rings) + 0.5) / model.rings)
    rays = np.stack((np.ones((model.rings, columns)), *np.meshgrid(y, z)), axis=-1).reshape(-1, 3)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def test_the_pixels_of_a_camera_are_those_of_a_pinhole():
    for sweep in (0, -7, 1000):
        np.testing.assert_allclose(directions(exact(D435), sweep=sweep), image(D435), atol=2e-6)
    assert D435.sees(image(D435)).all()
    edges = np.array([[1.0, 0.94, 0.55], [1.0, -0.94, -0.55], [1.0, 0.96, 0.0], [1.0, 0.0, 0.56], [-1.0, 0.0, 0.0]])
    np.testing.assert_array_equal(D435.sees(edges), [True, True, False, False, False])


@pytest.mark.parametrize("pattern", ["even", "rings", "livox"])
def test_every_pattern_keeps_to_its_azimuths(pattern: str):
    model = exact(LidarModel("narrow", pattern=pattern, rings=50, azimuth_min=-30.0, azimuth_max=80.0))
    d = directions(model)
    fired = np.isfinite(d[:, 0])
    assert fired.mean() == (pytest.approx(110.0 / 360.0, abs=0.01) if pattern == "livox" else 1.0)
    azimuth = np.degrees(np.arctan2(d[fired, 1], d[fired, 0]))
    assert -30.01 < azimuth.min() < -29.0 and 79.0 < azimuth.max() < 80.01
    assert np.mean(model.sees(d[fired])) > 0.95, "but those at the very edge"
    assert coverage(model)[-1] > (0.5 if pattern == "rings" else 0.99)


def test_the_points_of_several_sensors_are_those_of_each():
    """Three images belong to a sweep of a Mid-360, whose own rays stay the same."""
    both = exact(lidar_model("mid360+d435"))
    assert both.rays_per_sweep == 20_000 + 3 * D435.points_per_sweep
    d = directions(both, parts=5, sweep=2)
    first = directions(exact(LIDARS["mid360"]), parts=5, sweep=2)
    share = [k * both.rays_per_sweep // 5 for k in range(6)]
    images = [k * (3 * D435.points_per_sweep) // both.rays_per_sweep for k in share]
    own = np.concatenate([d[a : b - (j - i)] for a, b, i, j in zip(share, share[1:], images, images[1:], strict=False)])
    np.testing.assert_allclose(own, first, atol=2e-6)
    seen = np.concatenate([d[b - (j - i) : b] for b, i, j in zip(share[1:], images, images[1:], strict=False)])
    np.testing.assert_allclose(seen, np.tile(image(D435), (3, 1)), atol=2e-6)


def test_a_sensor_that_is_turned_looks_back():
    pair = exact(lidar_model("d435+d435@180"))
    d = directions(pair)
    np.testing.assert_allclose(d[: len(d) // 2], image(D435), atol=2e-6)
    np.testing.assert_allclose(d[len(d) // 2 :], image(D435) * [-1.0, -1.0, 1.0], atol=2e-6)
    assert pair.sees(d).all() and not pair.sees(np.array([[0.0, 1.0, 0.0]])).any()
    assert pair.name == "d435+d435@180"


@pytest.mark.parametrize(
    ("name", "problem"),
    [("mid36+d435", "did you mean 'mid360'"), ("d435+", "no LiDAR ''"), ("d435@left", "turns d435 by 'left'")],
)
def test_a_wrong_name_is_a_users_error(name: str, problem: str):
    with pytest.raises(UserError, match=problem):
        lidar_model(name)


@pytest.mark.parametrize("changes", [{"azimuth_min": 50.0}, {"elevation_max": 90.0}, {"rings": 48}])
def test_an_impossible_camera_is_refused(changes: dict[str, float]):
    with pytest.raises(ValueError, match=next(iter(changes))):
        dataclasses.replace(D435, **changes)
