from typing import Any

import numpy as np
import open3d
import pytest
import trimesh

from aero_viz.errors import UserError
from aero_viz.evaluation.world_export import export_world, surface_points
from aero_viz.scenes import World, scene

TILTED = [1.0, 2.0, 0.5, 0.6, 0.0, 0.8, 0.5, 3.0]


def world(**tables) -> World:
    return World(
        "w",
        np.zeros(3),
        np.array([9.0, 0.0, 0.0]),
        mission=None,
        **{key: np.array([row]) for key, row in tables.items()},
    )


@pytest.mark.parametrize(
    ("tables", "area"),
    [
        ({"cylinders": TILTED}, 2.0 * np.pi * 0.5 * (3.0 + 0.5)),
        ({"boxes": [1.0, -2.0, 3.0, 1.0, 2.0, 0.5, 0.7]}, 2.0 * (2.0 + 1.0 + 0.5)),
        ({"spheres": [1.0, 2.0, 3.0, 0.8]}, 4.0 * np.pi * 0.8**2),
    ],
    ids=["cylinder", "box", "sphere"],
)
def test_points_cover_a_primitive_evenly(tables, area):
    points = surface_points(world(**tables), spacing=0.1)
    assert np.abs(world(**tables).distance(points)).max() < 1e-9
    assert len(points) == pytest.approx(area / 0.1**2, rel=0.15)
    distances = np.linalg.norm(points[:, None] - points[None], axis=-1)
    np.fill_diagonal(distances, np.inf)
    nearest = distances.min(axis=1)
    assert np.quantile(nearest, 0.99) < 0.13 and nearest.max() < 0.16  # no holes
    assert np.quantile(nearest, 0.05) > 0.05  # no clusters


def test_buried_points_are_left_out():
    both = World(
        "w",
        np.zeros(3),
        np.array([9.0, 0.0, 0.0]),
        spheres=np.array([[0.0, 0.0, 3.0, 1.0], [1.0, 0.0, 3.0, 1.0]]),
        cylinders=np.array([TILTED]),
    )
    points = surface_points(both, spacing=0.1)
    assert both.distance(points).min() > -1e-5
    assert len(points) < len(surface_points(world(spheres=[0.0, 0.0, 3.0, 1.0]))) * 2 + len(
        surface_points(world(cylinders=TILTED))
    )


def test_only_the_top_of_the_ground_is_covered():
    points = surface_points(scene("forest", count=0), spacing=1.0)
    assert len(points) == 85 * 80 and (points[:, 2] == 0.0).all()


def test_export_is_deterministic_and_other_libraries_read_it(tmp_path):
    forest = scene("forest", seed=2, count=3)
    expected = surface_points(forest, spacing=0.5).astype(np.float32)
    for suffix in (".npy", ".pcd", ".ply"):
        assert export_world(forest, tmp_path / f"w{suffix}", spacing=0.5) == len(expected)
        export_world(forest, tmp_path / f"again{suffix}", spacing=0.5)
        assert (tmp_path / f"w{suffix}").read_bytes() == (tmp_path / f"again{suffix}").read_bytes()
    np.testing.assert_array_equal(np.load(tmp_path / "w.npy"), expected)
    cloud: Any = trimesh.load(tmp_path / "w.ply")
    np.testing.assert_array_equal(cloud.vertices.astype(np.float32), expected)
    for suffix in (".pcd", ".ply"):
        read = open3d.t.io.read_point_cloud(tmp_path / f"w{suffix}")
        np.testing.assert_array_equal(read.point.positions.numpy(), expected)


def test_export_as_json_gives_the_world(tmp_path):
    forest = scene("forest", seed=2, count=3)
    export_world(forest, tmp_path / "w.json")
    assert World.load(tmp_path / "w.json").to_dict() == forest.to_dict()


def test_user_errors(tmp_path):
    forest = scene("forest", seed=2, count=3)
    with pytest.raises(UserError, match=r"must end with one of .pcd"):
        export_world(forest, tmp_path / "w.xyz")
    with pytest.raises(UserError, match="must be positive"):
        surface_points(forest, spacing=0.0)
    with pytest.raises(UserError, match="use at least"):
        surface_points(forest, spacing=1e-4)
    with pytest.raises(UserError, match="Cannot write"):
        export_world(forest, tmp_path / "none" / "w.npy", spacing=5.0)
    assert surface_points(World("empty", np.zeros(3), np.ones(3))).shape == (0, 3)
