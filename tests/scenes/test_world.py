import json

import numpy as np
import pytest

from aero_viz.errors import UserError
from aero_viz.scenes import World, world_meshes


@pytest.fixture
def world() -> World:
    s = np.sqrt(0.5)
    return World(
        "mixed",
        np.array([0.0, 0.0, 2.0]),
        np.array([10.0, 0.0, 2.0]),
        cylinders=np.array([[4.0, 0.0, 0.0, 0.0, s, s, 0.3, 5.0], [6.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.5, 3.0]]),
        boxes=np.array([[8.0, -1.0, 1.0, 2.0, 1.0, 2.0, 0.6], [5.0, 0.0, -0.5, 40.0, 40.0, 1.0, 0.0]]),
        spheres=np.array([[2.0, 3.0, 4.0, 1.0]]),
    )


def write(path, **changes):
    content = {"name": "w", "start": [0, 0, 2], "goal": [5, 0, 2], **changes}
    path.write_text(json.dumps({key: value for key, value in content.items() if value is not None}))
    return path


def test_distance_to_cylinder():
    tower = World("", np.zeros(3), np.ones(3), cylinders=np.array([[1.0, 2.0, 0.0, 0.0, 0.0, 1.0, 0.5, 3.0]]))
    points = [[3.0, 2.0, 1.0], [1.0, 2.0, 5.0], [1.9, 2.0, 3.3], [1.0, 2.0, 1.5], [1.4, 2.0, 1.5], [1.0, 2.0, 2.9]]
    np.testing.assert_allclose(tower.distance(points), [1.5, 2.0, 0.5, -0.5, -0.1, -0.1], atol=1e-12)


def test_distance_to_box_with_yaw():
    box = World("", np.zeros(3), np.ones(3), boxes=np.array([[0.0, 0.0, 0.0, 4.0, 2.0, 2.0, np.pi / 2]]))
    points = [[0.0, 3.0, 0.0], [3.0, 0.0, 0.0], [4.0, 6.0, 0.0], [0.0, 0.0, 0.9]]
    np.testing.assert_allclose(box.distance(points), [1.0, 2.0, 5.0, -0.1], atol=1e-12)


def test_distance_is_the_nearest_sampled_surface_point(world):
    # Outside, the distance is the smallest one to any point of the surface, here sampled densely from its definition.
    rng = np.random.default_rng(0)
    base, axis, radius, height = world.cylinders[0, :3], world.cylinders[0, 3:6], 0.3, 5.0
    u, v = np.array([1.0, 0.0, 0.0]), np.cross(axis, [1.0, 0.0, 0.0])
    angle, along, share = (
        rng.uniform(0, 2 * np.pi, 200_000),
        rng.uniform(0, height, 200_000),
        rng.uniform(0, 1, 200_000),
    )
    ring = np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * v
    mantle = base + along[:, None] * axis + radius * ring
    disc = base + height * axis + radius * np.sqrt(share)[:, None] * ring
    surface = np.vstack([mantle, disc])
    inclined = World("", world.start, world.goal, cylinders=world.cylinders[:1])
    for point in ([4.0, 1.0, 3.0], [4.5, 5.0, 6.0], [2.0, 3.0, 5.0]):
        expected = np.linalg.norm(surface - point, axis=1).min()
        assert inclined.distance([point])[0] == pytest.approx(expected, abs=2e-2)


def test_distance_of_an_empty_world_is_infinite():
    assert World("", np.zeros(3), np.ones(3)).distance([[0.0, 0.0, 0.0]])[0] == np.inf


def test_save_and_load_change_nothing(world, tmp_path):
    world.save(tmp_path / "w.json")
    loaded = World.load(tmp_path / "w.json")
    for key in ("start", "goal", "cylinders", "boxes", "spheres", "bounds"):
        np.testing.assert_array_equal(getattr(loaded, key), getattr(world, key))
    assert loaded.name == "mixed"
    assert "bounds" not in json.loads((tmp_path / "w.json").read_text())


def test_explicit_bounds_are_kept(tmp_path):
    World.load(write(tmp_path / "a.json", bounds=[[-1, -2, -3], [9, 8, 7]])).save(tmp_path / "b.json")
    np.testing.assert_array_equal(World.load(tmp_path / "b.json").bounds, [[-1, -2, -3], [9, 8, 7]])


def test_optional_keys_default_to_empty_and_bounds_are_generous(tmp_path):
    world = World.load(write(tmp_path / "w.json"))
    assert (len(world.cylinders), len(world.boxes), len(world.spheres)) == (0, 0, 0)
    np.testing.assert_array_equal(world.bounds, [[-10.0, -10.0, -8.0], [15.0, 10.0, 12.0]])


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"goal": None}, '"goal" is missing'),
        ({"start": [0, 0]}, '"start" has 2 values'),
        ({"start": [0, "x", 0]}, "y = 'x'"),
        ({"cylinders": [[0, 0, 0, 0, 0, 1, 1, 1], [0, 0, 0, 0, 0, 1, 1]]}, '"cylinders" row 1 has 7 values'),
        ({"cylinders": [[0, 0, 0, 0, 0, 1, -1, 1]]}, '"cylinders" row 0 has radius = -1'),
        ({"cylinders": [[0, 0, 0, 0, 1, 1, 1, 1]]}, '"cylinders" row 0 has an axis of length 1.41'),
        ({"boxes": [[0, 0, 0, 1, 1, 0, 0]]}, '"boxes" row 0 has sz = 0'),
        ({"boxes": {"a": 1}}, '"boxes" is'),
        ({"spheres": [[0, 0, None, 1]]}, '"spheres" row 0 has z = None'),
        ({"bounds": [[0, 0, 0]]}, '"bounds" has 1 rows'),
        ({"bounds": [[0, 0, 5], [1, 1, 1]]}, '"bounds" row 0 must be less'),
        ({"name": 3}, '"name" is 3'),
        ({"spheers": []}, "unknown key 'spheers' (did you mean 'spheres'?)"),
    ],
)
def test_malformed_world_names_file_key_and_row(tmp_path, changes, expected):
    path = write(tmp_path / "bad.json", **changes)
    with pytest.raises(UserError) as caught:
        World.load(path)
    assert str(path) in str(caught.value) and expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_numbers_that_are_not_finite_are_refused(tmp_path):
    path = tmp_path / "w.json"
    path.write_text('{"name": "w", "start": [0, 0, NaN], "goal": [1, 1, 1]}')
    with pytest.raises(UserError, match="z = nan"):
        World.load(path)
    path.write_text(f'{{"name": "w", "start": [0, {10**400}, 0], "goal": [1, 1, 1]}}')
    with pytest.raises(UserError, match="y beyond 1e308"):
        World.load(path)


def test_a_key_that_is_given_twice_is_refused(tmp_path):
    path = tmp_path / "w.json"
    sphere = '"spheres": [[5, 0, 0, 1]]'
    path.write_text(f'{{"name": "w", "start": [0, 0, 0], "goal": [9, 0, 0], {sphere}, {sphere}}}')
    with pytest.raises(UserError, match=r"w\.json is not a world: the key 'spheres' is given twice"):
        World.load(path)


@pytest.mark.parametrize("content", [b"{", b"[1, 2]", b"\xff\xfe\x00", b"[" * 100_000])
def test_a_file_that_is_not_a_world_is_refused(tmp_path, content):
    path = tmp_path / "w.json"
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"w\.json"):
        World.load(path)


def test_missing_file_is_named(tmp_path):
    with pytest.raises(UserError, match=r"nowhere\.json"):
        World.load(tmp_path / "nowhere.json")


def test_arrays_are_read_only(world):
    with pytest.raises(ValueError, match="read-only"):
        world.cylinders[0, 0] = 1.0


def test_ground_is_the_box_under_start_and_goal(world):
    assert world.ground.tolist() == [False, True]


def test_meshes_lie_on_the_surfaces(world):
    meshes = world_meshes(world)
    assert set(meshes) == {"cylinders", "boxes", "ground", "spheres"}
    for mesh in meshes.values():
        assert mesh.faces.max() < len(mesh.vertices)
    tables = {"cylinders": {"cylinders": world.cylinders}, "spheres": {"spheres": world.spheres}}
    tables |= {"boxes": {"boxes": world.boxes[:1]}, "ground": {"boxes": world.boxes[1:]}}
    for kind, table in tables.items():
        alone = World("", world.start, world.goal, **table)
        np.testing.assert_allclose(alone.distance(meshes[kind].vertices), 0.0, atol=1e-5)


def test_mesh_faces_point_outward(world):
    # The signed volume of a closed mesh with outward faces is positive and near that of the solid, which it
    # approximates from inside: coarsely, since it is for drawing only.
    box = world_meshes(world)["boxes"]
    a, b, c = (box.vertices[box.faces[:, i]].astype(float) for i in range(3))
    assert np.sum(np.cross(a, b) * c) / 6.0 == pytest.approx(4.0, rel=1e-5)
    for kind, volume in (("spheres", 4 / 3 * np.pi), ("cylinders", np.pi * (0.09 * 5.0 + 0.25 * 3.0))):
        mesh = world_meshes(world)[kind]
        a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(float) for i in range(3))
        assert 0.6 * volume < np.sum(np.cross(a, b) * c) / 6.0 < volume


def test_ground_height():
    ends = np.array([0.0, 0, 2]), np.array([10.0, 0, 2])
    assert World("none", *ends).ground_height is None
    assert World("aside", *ends, boxes=np.array([[5.0, 0, 0.5, 1, 1, 1, 0]])).ground_height is None
    below = np.array([[5.0, 0, -1, 40, 40, 1, 0], [5.0, 0, -3, 40, 40, 2, 0]])
    assert World("below", *ends, boxes=below).ground_height == -0.5


@pytest.mark.parametrize("yaw", [90.0, -45.0, 6.3])
def test_an_angle_in_degrees_is_refused(yaw: float):
    with pytest.raises(ValueError, match=r'"boxes" row 1 has yaw = .*it must be an angle \[rad\] .* 90 deg are 1.5708'):
        World("w", np.zeros(3), np.ones(3), boxes=np.array([[0.0, 0, -1, 9, 9, 1, 6.28], [5.0, 0, -1, 1, 1, 1, yaw]]))


def test_ground_is_still_ground_if_the_goal_lies_below_it():
    start, floor, deck = np.array([0.0, 0, 2]), [5.0, 0, -1, 40, 40, 1, 0], [5.0, 0, 1, 40, 40, 1, 0]

    def height(goal: list[float], *boxes: list[float]) -> float | None:
        return World("w", start, np.array(goal), boxes=np.array(boxes)).ground_height

    assert height([10.0, 0, -2], floor) == height([10.0, 0, -0.7], floor) == -0.5
    assert height([10.0, 0, 0.2], floor, deck) == -0.5, "below a deck is above the floor"
    assert height([90.0, 0, -2], floor) is None, "beside it is not below it"


def movers(motion, **changes) -> World:
    rows = np.array([[4.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.5, 3.0]] * len(motion))
    return World("", np.zeros(3), np.array([9.0, 0.0, 1.0]), cylinders=rows, motion=np.array(motion), **changes)


def test_a_moving_cylinder_goes_forth_and_back():
    world = movers([[1.2, -1.6, 3.0], [0.0, 0.0, 0.0]])  # 2 m/s over 3 m
    places = [world.at(time).cylinders[0, :2] for time in (0.0, 1.0, 1.5, 2.0, 3.0, 4.0, 301.0, -0.5)]
    gone = [0.0, 2.0, 3.0, 2.0, 0.0, 2.0, 2.0, 1.0]
    np.testing.assert_allclose(places, [[4.0 + 0.6 * s, 1.0 - 0.8 * s] for s in gone], atol=1e-9)
    assert np.array_equal(world.at(1.0).cylinders[1], world.cylinders[1])
    assert world.moves.tolist() == [True, False]
    # A moment is a static world in the same bounds, and rows keep their numbers.
    moment = world.at(1.0)
    assert len(moment.motion) == 0 and moment.at(7.0) is moment
    assert np.array_equal(moment.bounds, world.bounds)
    assert moment.distance([[5.2, -0.6, 1.0]])[0] == pytest.approx(-0.5)


def test_distances_are_those_at_the_time_of_each_point():
    world, points = movers([[1.2, -1.6, 3.0], [0.0, 0.0, 0.0]]), np.array([[5.2, -0.6, 1.0], [4.0, 1.0, 1.0]])
    np.testing.assert_allclose(world.distance(points, [1.0, 3.0]), [-0.5, -0.5])
    np.testing.assert_allclose(world.distance(points, 1.0), [world.at(1.0).distance(p)[0] for p in points])
    assert np.array_equal(world.distance(points), world.at(0.0).distance(points))


def test_bounds_contain_the_whole_motion():
    assert movers([[0.0, 2.0, 30.0]]).bounds[1, 1] == pytest.approx(1.0 + 30.0 + 0.5 + 10.0)


def test_a_world_in_which_nothing_moves_is_itself_at_any_time(world):
    assert world.at(5.0) is world and world.standing() is world
    assert "motion" not in world.to_dict()
    still = movers([[0.0, 0.0, 4.0]])
    assert still.motion.shape == (0, 3) and still.at(5.0) is still


def test_standing_leaves_out_what_moves():
    world = movers([[1.0, 0.0, 3.0], [0.0, 0.0, 0.0]])
    assert len(world.standing().cylinders) == 1 and len(world.standing().motion) == 0


def test_motion_is_saved_and_loaded(tmp_path):
    world = movers([[1.2, -1.6, 3.0], [0.0, 0.0, 0.0]])
    world.save(tmp_path / "world.json")
    loaded = World.load(tmp_path / "world.json")
    assert np.array_equal(loaded.motion, world.motion) and np.array_equal(loaded.bounds, world.bounds)
    assert loaded.to_json() == world.to_json()


@pytest.mark.parametrize(
    ("motion", "expected"),
    [
        ([], None),
        ([[1, 0, 5]], None),
        ([[1, 0, 5], [1, 0, 5]], '"motion" has 2 rows for 1 cylinders'),
        ([[1, 0]], '"motion" row 0 has 2 values; it must have 3 numbers (vx, vy, span)'),
        ([[1, 0, 0]], '"motion" row 0 has span = 0'),
        ([[0, 0, -1]], '"motion" row 0 has span = -1'),
        ([[90, 90, 5]], '"motion" row 0 has a speed of 127.279 m/s'),
        ([[1, None, 5]], '"motion" row 0 has vy = None'),
    ],
)
def test_a_malformed_motion_is_refused_by_row(tmp_path, motion, expected):
    path = write(tmp_path / "world.json", cylinders=[[4, 1, 0, 0, 0, 1, 0.5, 3]], motion=motion)
    if expected is None:
        World.load(path)
    else:
        with pytest.raises(UserError) as refusal:
            World.load(path)
        assert expected in str(refusal.value)
