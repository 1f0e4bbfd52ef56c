"""Worlds that are fitted to clouds: the solids that the points were sampled from are found again."""

import re
import sys
from pathlib import Path

import bags
import imageio.v3 as iio
import numpy as np
import pytest
import trimesh
from command_line import run, run_refused

from aero_viz.errors import UserError
from aero_viz.flight import fly
from aero_viz.scenes import World
from aero_viz.scenes.from_cloud import FittedWorld, fit_world

SLOPE, NOISE, TOLERANCE = 0.12, 0.02, 0.1
LOW, HIGH = np.array([-4.0, -8.0]), np.array([26.0, 8.0])
LEAN = np.array([0.12, -0.05, 1.0]) / np.linalg.norm([0.12, -0.05, 1.0])
TRUNKS = np.array([[x, y, SLOPE * x, *LEAN, 0.12 + 0.03 * i, 5.0]
                   for i, (x, y) in enumerate([(4, 3), (8, -4), (13, 1.5), (17, -5), (22, 4)])])  # fmt: skip
WALL = np.array([10.0, 6.0, SLOPE * 10.0 + 1.4, 5.0, 0.3, 2.8, 0.3])
BLOB = np.array([18.0, 0.0, SLOPE * 18.0 + 1.5, 0.8])


def ground(count: int, random: np.random.Generator, slope: float = SLOPE) -> np.ndarray:
    place = random.uniform(LOW, HIGH, (count, 2))
    return np.column_stack([place, slope * place[:, 0]])


def on_trunk(row: np.ndarray, count: int, random: np.random.Generator) -> np.ndarray:
    """Return points on the side of a cylinder."""
    angle, along = random.uniform(0.0, 2.0 * np.pi, count), random.uniform(0.0, row[7], count)
    u = np.cross(row[3:6], [1.0, 0.0, 0.0]) / np.linalg.norm(np.cross(row[3:6], [1.0, 0.0, 0.0]))
    around = np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * np.cross(row[3:6], u)
    return row[:3] + along[:, None] * row[3:6] + row[6] * around


def on_wall(row: np.ndarray, count: int, random: np.random.Generator) -> np.ndarray:
    """Return points on the long sides and the ends of a box."""
    local = random.uniform(-0.5, 0.5, (count, 3))
    is_end = random.uniform(size=count) < row[4] / (row[3] + row[4])
    local[is_end, 0], local[~is_end, 1] = (np.sign(part) / 2 for part in (local[is_end, 0], local[~is_end, 1]))
    x, y, z = (local * row[3:6]).T
    c, s = np.cos(row[6]), np.sin(row[6])
    return row[:3] + np.column_stack([c * x - s * y, s * x + c * y, z])


@pytest.fixture(scope="module")
def surfaces() -> np.ndarray:
    """Noisy points on all solids that a scanner sees, so none below the ground."""
    random = np.random.default_rng(0)
    directions = random.normal(size=(900, 3))
    blob = BLOB[:3] + BLOB[3] * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    solids = [*(on_trunk(row, 900, random) for row in TRUNKS), on_wall(WALL, 3500, random), blob]
    points = np.vstack([ground(30_000, random), *solids])
    points = points[points[:, 2] >= SLOPE * points[:, 0] - 1e-9]
    return points + random.normal(0.0, NOISE, points.shape)


@pytest.fixture(scope="module")
def strays() -> np.ndarray:
    return np.random.default_rng(1).uniform([*LOW, 0.0], [*HIGH, 12.0], (150, 3))


@pytest.fixture(scope="module")
def fitted(surfaces: np.ndarray, strays: np.ndarray) -> FittedWorld:
    return fit_world(np.vstack([surfaces, strays]), "park.pcd", tolerance=TOLERANCE)


def test_the_solids_are_found_again(fitted: FittedWorld):
    assert (fitted.planes, fitted.trunks, fitted.walls) == (1, len(TRUNKS), 1)
    for row in TRUNKS:
        middle = row[:3] + 0.5 * row[7] * row[3:6]
        relative = middle - fitted.world.cylinders[:, :3]
        off = np.linalg.norm(np.cross(relative, fitted.world.cylinders[:, 3:6]), axis=1)
        found = fitted.world.cylinders[off.argmin()]
        assert off.min() < 0.03 and found[6] == pytest.approx(row[6], abs=0.02)
        assert found[3:6] @ row[3:6] > 0.999 and found[7] == pytest.approx(row[7], abs=0.25)
    wall = fitted.world.boxes[0]
    np.testing.assert_allclose(wall[[0, 1, 3, 4]], WALL[[0, 1, 3, 4]], atol=0.05)
    assert wall[6] == pytest.approx(WALL[6], abs=0.02)
    assert wall[2] + 0.5 * wall[5] == pytest.approx(WALL[2] + 0.5 * WALL[5], abs=0.05)


def test_the_points_lie_on_the_world_and_strays_do_not_become_obstacles(
    fitted: FittedWorld, surfaces: np.ndarray, strays: np.ndarray
):
    distances = np.abs(fitted.world.distance(surfaces))
    assert np.quantile(distances, 0.95) < TOLERANCE and fitted.residual < TOLERANCE
    height = strays[:, 2] - SLOPE * strays[:, 0]
    alone = fitted.world.distance(strays)[(height > 1.0) & (World("", np.zeros(3), np.zeros(3), cylinders=TRUNKS,
            boxes=WALL[None], spheres=BLOB[None]).distance(strays) > 1.0)]  # fmt: skip
    assert len(alone) > 50 and (alone > 0.3).mean() > 0.95
    blob = BLOB[:3] + BLOB[3] * np.eye(3)
    assert np.abs(fitted.world.distance(blob)).max() < TOLERANCE and fitted.mesh > 20


def test_the_world_can_be_flown(fitted: FittedWorld, tmp_path: Path):
    fitted.world.save(tmp_path / "park.json")
    result = fly(World.load(tmp_path / "park.json"), seed=1)
    assert result.arrived, result


def test_a_window_and_a_door_stay_open():
    random = np.random.default_rng(2)
    wall = on_wall(np.array([5.0, 0.0, 1.5, 8.0, 0.2, 3.0, 0.0]), 9000, random)
    window = (np.abs(wall[:, 0] - 3.0) < 0.8) & (np.abs(wall[:, 2] - 1.7) < 0.7)
    door = (np.abs(wall[:, 0] - 7.0) < 0.6) & (wall[:, 2] < 2.2)
    flat = fit_world(np.vstack([ground(20_000, random, slope=0.0), wall[~window & ~door]]), "wall.pcd")
    openings = np.array([[3.0, 0.0, 1.7], [7.0, 0.0, 1.3]])
    assert flat.world.distance(openings).min() > 0.35
    assert np.abs(flat.world.distance(wall[~window & ~door])).max() < 0.3
    assert flat.world.ground_height == pytest.approx(0.0, abs=0.02)


def test_the_result_is_the_same_every_time_and_everywhere(
    surfaces: np.ndarray, fitted: FittedWorld, strays: np.ndarray
):
    far = np.array([500_000.0, 5_000_000.0, 300.0])
    moved = fit_world(
        np.vstack([surfaces, strays]) + far,
        "park.pcd",
        start=far + np.array([0, 0, 2]),
        goal=far + np.array([24, 0, 5]),
    )
    np.testing.assert_allclose(moved.world.goal - moved.world.start, [24.0, 0.0, 3.0], atol=1e-6)
    assert (moved.planes, moved.trunks, moved.walls) == (fitted.planes, fitted.trunks, fitted.walls)


def test_ground_alone_solids_alone_and_scattered_points():
    random = np.random.default_rng(3)
    bare = fit_world(ground(10_000, random, slope=0.0), "field.pcd")
    assert (bare.planes, bare.trunks, bare.walls, len(bare.world.boxes)) == (1, 0, 0, 1)
    aloft = fit_world(on_trunk(TRUNKS[0], 2000, random), "trunk.pcd", start=[0, 0, 2], goal=[9, 0, 2])
    assert (aloft.planes, aloft.trunks) == (0, 1)
    with pytest.raises(UserError, match="scattered points only"):
        fit_world(random.uniform(-500.0, 500.0, (300, 3)), "dust.pcd", start=[0, 0, 2], goal=[9, 0, 2])


def test_the_command_says_what_it_found_in_a_bag_and_draws_it(tmp_path: Path, capsys, surfaces: np.ndarray):
    bag = bags.write_mcap(tmp_path / "park.mcap", [bags.cloud(0, bags.xyz(surfaces), frame="map", topic="/map")])
    output, picture = tmp_path / "park.json", tmp_path / "park.png"
    code, text, error = run(capsys, "world", "export", str(bag), str(output), "--fit", "0.1", "--picture", str(picture))
    assert code == 0, error
    assert "1 plane of ground, 5 trunks, 1 wall" in text and "within the tolerance of 0.1 m" in text
    assert len(World.load(output).cylinders) == 5
    image = iio.imread(picture)
    left, right = np.array_split(image[40:], 2, axis=1)
    assert image.shape[1] > 1000 and not np.array_equal(left[:, :800], right[:, -800:])
    assert len(np.unique(right.reshape(-1, 3), axis=0)) >= 5, "every kind has its colour"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["park.xyz", "w.json", "--fit", "5"], r"tolerance is 5.0 m; it must be in \[0.01, 1.0\] m"),
        (["park.xyz", "w.json", "--fit", "0.1"], "park.xyz has 3 points .* give a cloud of more points"),
        (["park.xyz", "w.json", "--fit", "0.1", "--voxel", "0.1"], "leave --count and --voxel out"),
        (["park.xyz", "w.json", "--picture", "w.png"], "add --fit 0.1, or leave --picture out"),
        (["park.xyz", "w.json", "--fit", "0.1", "--picture", "w.jpg"], "choose one that ends in .png"),
        (["park.stl", "w.json", "--fit", "0.1"], "park.stl is a mesh, and a cloud of points is needed"),
        (["forest", "w.json", "--fit", "0.1"], "forest is not a map"),
    ],
)
def test_mistakes_are_reported_in_one_line(tmp_path: Path, capsys, arguments: list[str], words: str):
    (tmp_path / "park.xyz").write_text("0 0 0\n1 0 0\n0 1 0\n")
    trimesh.creation.box().export(tmp_path / "park.stl")
    paths = [str(tmp_path / word) if "." in word and not word[0].isdigit() else word for word in arguments]
    error = run_refused(capsys, "world", "export", *paths)
    assert error.count("\n") == 1 and re.search(words, error), error


def test_a_machine_without_open3d_is_told_how_to_install_it(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(UserError, match="pip install open3d-cpu"):
        fit_world(np.zeros((100, 3)), "park.pcd")
