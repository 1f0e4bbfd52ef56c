import numpy as np

from aero_planner.forest_cloud import forest_cloud


def test_a_cloud_depends_on_its_seed_alone():
    cloud = forest_cloud(5000, seed=1)
    assert cloud.shape == (5000, 3) and cloud.dtype == np.float32
    np.testing.assert_array_equal(cloud, forest_cloud(5000, seed=1))
    assert not np.array_equal(cloud, forest_cloud(5000, seed=2), equal_nan=True)


def test_a_cloud_is_like_that_of_a_mid360_in_flight():
    cloud = forest_cloud(50_000, seed=3)
    missed = np.isnan(cloud)
    np.testing.assert_array_equal(missed.any(axis=1), missed.all(axis=1))
    assert 0.35 < missed[:, 0].mean() < 0.65
    points = cloud[~missed[:, 0]]
    distance = np.linalg.norm(points - [0.0, 0.0, 2.0], axis=1)
    assert distance.min() > 0.3 and distance.max() < 44.0
    assert 0.4 < (distance < 10.0).mean() < 0.95
    on_ground = np.abs(points[:, 2]) < 0.1
    assert 0.05 < on_ground.mean() < 0.5 and points[:, 2].min() > -0.1 and points[:, 2].max() < 8.2


def test_a_cloud_may_be_empty():
    assert forest_cloud(0).shape == (0, 3)
