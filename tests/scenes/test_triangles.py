"""Triangulated surfaces: rays, distances, paths, files and flights."""

import math

import numpy as np
import pytest
import trimesh
import warp as wp

from aero_planner import PlannerConfig
from aero_viz.errors import UserError
from aero_viz.evaluation.world_export import surface_points
from aero_viz.flight import FlightBatch, FlightRules, fly
from aero_viz.scenes import World, load_map
from aero_viz.scenes.device_worlds import DeviceWorlds
from aero_viz.scenes.passable import is_passable
from aero_viz.sensors import LidarModel, cast

START, GOAL = np.array([0.0, 0.0, 2.0]), np.array([10.0, 0.0, 2.0])


def world(triangles=(), **tables) -> World:
    rows = np.array(triangles, dtype=float).reshape(-1, 9)
    tables = {key: np.array(table, dtype=float) for key, table in tables.items()}
    return World("test", START, GOAL, triangles=rows, mission=None, **tables)


def scattered(count: int, seed: int = 0):
    rng = np.random.default_rng(seed)
    centre = rng.uniform([-8, -8, -8], [8, 8, 8], (count, 1, 3))
    return (centre + rng.uniform(-1.5, 1.5, (count, 3, 3))).reshape(-1, 9)


def first_hit(triangles, origin, direction) -> float:
    """Distance to the first triangle along a ray, solved for o + t d = a + u (b - a) + v (c - a) in float64."""
    nearest = math.inf
    for a, b, c in triangles.reshape(-1, 3, 3):
        matrix = np.column_stack([-direction, b - a, c - a])
        if abs(np.linalg.det(matrix)) > 1e-12:
            t, u, v = np.linalg.solve(matrix, origin - a)
            if t >= 0.0 and u >= 0.0 and v >= 0.0 and u + v <= 1.0:
                nearest = min(nearest, t)
    return nearest


def nearest_point(triangle, point) -> float:
    """Distance to a triangle in float64: to its plane if the projection lies inside, otherwise to the nearest edge."""
    a, b, c = triangle.reshape(3, 3)
    normal = np.cross(b - a, c - a)
    foot = point - normal * (normal @ (point - a)) / (normal @ normal)
    if all(normal @ np.cross(q - p, foot - p) >= 0.0 for p, q in ((a, b), (b, c), (c, a))):
        return float(np.linalg.norm(foot - point))
    sides = []
    for p, q in ((a, b), (b, c), (c, a)):
        share = np.clip((q - p) @ (point - p) / ((q - p) @ (q - p)), 0.0, 1.0)
        sides.append(float(np.linalg.norm(p + share * (q - p) - point)))
    return min(sides)


def ranges(solid: World, origin, directions, **options):
    worlds = DeviceWorlds([solid])
    rays = wp.array([np.asarray(directions, dtype=np.float32)], dtype=wp.vec3)
    return cast(worlds, wp.array([origin], dtype=wp.vec3), rays, **options).numpy()[0]


def test_rays_match_the_float64_reference():
    rng = np.random.default_rng(1)
    triangles, origin = scattered(400), np.array([0.3, -0.2, 0.1])
    directions = rng.normal(size=(150, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    expected = np.array([first_hit(triangles, origin, direction) for direction in directions])
    found = ranges(world(triangles), origin, directions)
    sure = np.isfinite(expected) == np.isfinite(found)
    assert sure.mean() > 0.99 and 20 < np.isfinite(expected).sum() < 130  # rays along an edge may go either way
    np.testing.assert_allclose(found[sure], expected[sure], atol=1e-4)


def test_both_sides_are_seen_and_the_nearest_obstacle_of_any_kind_wins():
    square = [[4, -1, 1, 4, 1, 1, 4, 1, 3], [4, -1, 1, 4, 1, 3, 4, -1, 3]]
    forward, back = [[1.0, 0.0, 0.0]], [[-1.0, 0.0, 0.0]]
    assert ranges(world(square), [0, 0, 2], forward)[0] == pytest.approx(4.0)
    assert ranges(world(square), [9, 0, 2], back)[0] == pytest.approx(5.0)
    assert ranges(world(square), [9, 0, 2], forward)[0] == np.inf
    assert ranges(world(square), [0, 0, 2], forward, range_max=3.9)[0] == np.inf
    for ball, hit in ((2.0, 1.5), (6.0, 4.0)):  # before and behind the square
        mixed = world(square, spheres=[[ball, 0, 2, 0.5]])
        assert ranges(mixed, [0, 0, 2], forward)[0] == pytest.approx(hit)


def test_distances_match_the_float64_reference():
    rng = np.random.default_rng(2)
    triangles = scattered(40)
    points = rng.uniform(-12, 12, (200, 3))
    expected = [min(nearest_point(triangle, point) for triangle in triangles) for point in points]
    np.testing.assert_allclose(world(triangles).distance(points), expected, atol=2e-5)
    row = int(np.argmin([nearest_point(triangle, points[0]) for triangle in triangles]))
    assert world(triangles).nearest(points[0]) == (pytest.approx(expected[0], abs=2e-5), f"triangle {row}")


def test_json_keeps_triangles_and_omits_the_key_without_them(tmp_path):
    surface = world(scattered(3), spheres=[[5, 5, 5, 1]])
    surface.save(tmp_path / "w.json")
    loaded = World.load(tmp_path / "w.json")
    np.testing.assert_array_equal(loaded.triangles, surface.triangles)
    np.testing.assert_array_equal(loaded.bounds, surface.bounds)
    assert "triangles" not in world(spheres=[[5, 5, 5, 1]]).to_dict()
    for rows, message in (([[0] * 8], '"triangles" row 0 has 8 values'), ([[0] * 8 + [2e5]], "row 0 has z3 = 200000")):
        with pytest.raises(ValueError, match=message):
            World("", START, GOAL, triangles=rows)  # type: ignore[arg-type]


def of_boxes(boxes):
    """Return the faces of boxes without yaw as triangles."""
    meshes = [trimesh.creation.box(extents=row[3:6]).apply_translation(row[:3]) for row in boxes]
    return np.concatenate([mesh.triangles.reshape(-1, 9) for mesh in meshes])


GAP = [[5.0, -5.3, 2.0, 0.4, 9.8, 8.0, 0.0], [5.0, 5.3, 2.0, 0.4, 9.8, 8.0, 0.0]]  # 0.8 m between two walls


def test_triangles_of_boxes_block_the_same_paths_as_the_boxes():
    for radius in (0.25, 0.31, 0.35, 0.401, 0.45):
        answers = [is_passable(w, radius=radius, cell=0.1) for w in (world(boxes=GAP), world(of_boxes(GAP)))]
        assert answers == [radius < 0.4] * 2, radius


def test_surface_points_lie_on_triangles_without_gaps():
    points = surface_points(world([[0, 0, 0, 3, 0, 0, 0, 2, 1]]), spacing=0.1)
    assert np.abs(world([[0, 0, 0, 3, 0, 0, 0, 2, 1]]).distance(points)).max() < 1e-5
    corners = np.array([[0, 0, 0], [3, 0, 0], [0, 2, 1.0]])
    inside = np.random.default_rng(0).dirichlet([1, 1, 1], 300) @ corners
    gaps = np.linalg.norm(inside[:, None] - points[None], axis=2).min(axis=1)
    assert gaps.max() < 0.1


@pytest.fixture
def hall(tmp_path):
    """Return a function that writes a floor and a ball as a mesh in any format."""
    floor = trimesh.creation.box(extents=(60, 40, 1)).apply_translation((20, 0, -0.5))
    ball = trimesh.creation.icosphere(subdivisions=3, radius=2.0).apply_translation((15, 0.5, 2))
    mesh = trimesh.util.concatenate([floor, ball])

    def write(suffix: str) -> str:
        mesh.export(tmp_path / f"hall{suffix}")
        return str(tmp_path / f"hall{suffix}")

    return write


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".glb", ".off", ".ply"])
def test_mesh_files(hall, suffix):
    loaded = load_map(hall(suffix), start=[0, 0, 2], goal=[30, 0, 2])
    assert (loaded.name, len(loaded.triangles), len(loaded.boxes)) == ("hall", 12 + 1280, 0)
    np.testing.assert_allclose(loaded.distance([[15, 0.5, 6.0], [0, 0, 2.0]]), [2.0, 2.0], atol=0.03)


def test_start_and_goal_are_chosen_above_the_floor_of_a_mesh(hall):
    found = load_map(hall(".stl"))
    assert found.start[2] == found.goal[2] == 2.0 and np.linalg.norm(found.goal - found.start) > 20.0
    assert found.distance([found.start, found.goal]).min() >= 0.75


def test_a_ply_of_points_stays_a_map_of_voxels(tmp_path):
    trimesh.PointCloud(np.random.default_rng(0).uniform(0, 9, (500, 3))).export(tmp_path / "points.ply")
    found = load_map(tmp_path / "points.ply", start=[-5, 0, 2], goal=[15, 0, 2])
    assert len(found.boxes) > 100 and len(found.triangles) == 0


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("bad.obj", b"junk", "holds no triangles"),
        ("flat.obj", b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "holds no triangles"),
        ("bad.glb", b"glTF\x02\x00\x00\x00junk", "Cannot read the mesh"),
        ("bad.ply", b"ply\nformat ascii 1.0\nelement vertex 3\nelement face 1\nend_header\n", "bad.ply"),
        ("far.obj", b"v 0 0 0\nv 9e5 0 0\nv 0 1 0\nf 1 2 3\n", "spans 900 km along x, and at most 20 km can be used"),
    ],
)
def test_damaged_meshes_are_refused_in_one_sentence(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError) as caught:
        load_map(tmp_path / name, start=[0, 0, 2], goal=[9, 0, 2])
    assert message in str(caught.value) and name in str(caught.value) and "\n" not in str(caught.value)


def test_a_mesh_has_no_voxels_and_voxels_have_a_size(hall, tmp_path):
    with pytest.raises(UserError, match="no voxels"):
        load_map(hall(".stl"), voxel=0.2)
    np.save(tmp_path / "a.npy", np.zeros((3, 3)))
    with pytest.raises(UserError, match=r"edge of 1e-09 m; it must be in \[0.01, 100.0\]"):
        load_map(tmp_path / "a.npy", voxel=1e-9)


def test_a_flight_sees_triangles_and_collides_with_them(hall):
    flown = fly(
        load_map(hall(".stl"), start=[0, 0, 2], goal=[30, 0, 2]), config=PlannerConfig.preset("fast-cpu"), seed=2
    )
    assert flown.arrived and flown.min_clearance is not None and 0.25 <= flown.min_clearance < 2.0
    wall = [[0.2, -9, -9, 0.2, 9, -9, 0.2, 0, 9]]
    started = fly(world(wall), lidar=LidarModel("small", points_per_sweep=100))
    assert started.reason == "collision" and started.explanation is not None
    assert "0.200 m from triangle 0" in started.explanation


def test_each_flight_of_a_batch_has_its_own_triangles():
    rules = FlightRules(time_limit=0.2)
    lidar = LidarModel("small", points_per_sweep=500)
    config = PlannerConfig().replace({"sampling.samples": 8})
    worlds = [
        world(of_boxes(GAP)),
        world(spheres=[[5, 5, 2, 1]]),
        world(scattered(30, seed=4) + np.tile([20, 0, 0], 3)),
    ]
    together = FlightBatch(worlds, config=config, lidar=lidar, rules=rules, seed=3)
    for b, (world_b, result) in enumerate(zip(worlds, together.run(), strict=True)):
        alone = FlightBatch([world_b], config=config, lidar=lidar, rules=rules, seed=3 + b).run()[0]
        assert (alone.min_clearance, alone.smoothness) == (result.min_clearance, result.smoothness)
