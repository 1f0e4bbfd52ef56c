import dataclasses

import numpy as np
import pytest
import warp as wp

from aero_viz.scenes import World
from aero_viz.scenes.device_worlds import DeviceWorlds
from aero_viz.sensors import LIDARS, Lidar, LidarModel, coverage

MID360, FULL_SPHERE, SPINNING64 = (LIDARS[name] for name in ("mid360", "full-sphere", "spinning64"))


def test_coverage_of_the_mid360_grows_from_sweep_to_sweep():
    # 72 rings of points in a sweep, not evenly spread over 19 rows of 3 deg: some cells wait for the next sweeps.
    for seed in range(5):
        first, half, second = coverage(MID360, seed=seed)
        assert 0.9 < first < 0.99 and first < half and 0.999 <= half <= second
    fine = coverage(MID360, cell=1.0, times=(0.1, 0.2, 0.5, 1.0))
    assert 0.55 < fine[0] < 0.7 and np.all(np.diff(fine) > 0.0) and 0.95 < fine[-1] < 1.0


def test_coverage_of_even_rays():
    # 59 x 360 cells of 1 deg. Even rays per solid angle: a cell of elevation e gets 20 000 cos(e) / (2 pi 0.91) rays of
    # 3.05e-4 sr, 1.07 at the horizon; that many random rays would hit 1 - exp(-n), even ones more.
    even = LidarModel("even", pattern="even")
    shares = coverage(even, cell=1.0, times=(0.05, 0.1, 0.5, 1.0))
    edges = np.sin(np.radians(np.arange(-7.0, 53.0)))
    per_cell = 20_000 * np.diff(edges) / (np.sin(np.radians(52.0)) - np.sin(np.radians(-7.0))) / 360.0
    assert np.mean(1.0 - np.exp(-per_cell)) < shares[1] <= np.minimum(per_cell, 1.0).mean()
    assert shares[0] < shares[1] < shares[2] and shares[2] >= 0.999 and shares[3] == 1.0
    assert coverage(even)[0] >= 0.995  # in the coarser cells at once


def test_a_spinning_lidar_never_covers_the_space_between_its_rings():
    # 64 rings over 45 degrees in 90 rows of half a degree: no more rows than rings, however long it turns.
    shares = coverage(SPINNING64, cell=0.5)
    assert shares[0] == shares[-1] <= 64 / 90 + 1e-9


def test_the_poles_of_the_full_sphere_are_covered_slowly():
    # 2.4e-6 of the sphere is in a cell at the pole: half a hit expected there after a second.
    first, half, second = coverage(FULL_SPHERE)
    assert 0.85 < first < half < second < 1.0


def test_agrees_with_the_points_of_the_sensor():
    model = dataclasses.replace(MID360, points_per_sweep=3000, range_noise=0.0, dropout=0.0)
    walls = [[s * 15.0 * (k == i) for k in range(3)] for i in range(3) for s in (-1, 1)]
    shell = World(
        "", np.zeros(3), np.ones(3), boxes=np.array([[*c, *[10.0 if v else 60.0 for v in c], 0.0] for c in walls])
    )
    lidar = Lidar(model, DeviceWorlds([shell]), seeds=[9])
    poses = wp.zeros(1, dtype=wp.vec3), wp.array([(1.0, 0.0, 0.0, 0.0)], dtype=wp.vec4)
    lidar.scan(0, 0, 3000, poses=poses, poses_before=poses, active=wp.ones(1, dtype=int))
    points = lidar.points.numpy()[0].astype(float)
    row = np.floor((np.degrees(np.arcsin(points[:, 2] / np.linalg.norm(points, axis=1))) + 90.0) / 3.0)
    column = np.floor((np.degrees(np.arctan2(points[:, 1], points[:, 0])) + 180.0) / 3.0)
    within = (row >= 28) & (row < 47)  # -6 .. 51 deg
    hit = len(np.unique(row[within] * 120 + column[within])) / (19 * 120)
    (share,) = coverage(model, times=[0.1], seed=9)
    assert share == pytest.approx(hit, abs=3 / (19 * 120))  # rays on an edge may fall to either side


@pytest.mark.parametrize("options", [{"cell": 0.0}, {"cell": 7.0}, {"cell": 60.0}, {"times": (0.5, 0.1)}])
def test_invalid_arguments_are_refused(options):
    with pytest.raises(ValueError, match="cell"):
        coverage(MID360, **options)
