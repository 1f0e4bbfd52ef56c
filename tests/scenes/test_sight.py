"""Obstacles that block a line of sight."""

import numpy as np
import pytest

from aero_viz.scenes import SightLines, World, scene

START, GOAL = np.array([0.0, 0.0, 2.0]), np.array([20.0, 0.0, 2.0])


def blocked(world: World, eye, target=START, *, radius: float = 0.3) -> dict[str, list[int]]:
    rows = SightLines(world).blocked_by(np.array(eye), np.array([target]), np.array([radius]))
    return {kind: found.tolist() for kind, found in rows.items() if len(found)}


def test_only_what_is_between_eye_and_target_blocks():
    trunks = np.array([[x, y, 0.0, 0.0, 0.0, 1.0, 0.2, 5.0] for x, y in ((-3.0, 0.0), (-3.0, 2.0), (1.0, 0.0))])
    world = World("trunks", START, GOAL, cylinders=trunks)
    assert blocked(world, (-6.0, 0.0, 3.0)) == {"cylinders": [0]}
    assert blocked(world, (6.0, 0.0, 3.0)) == {"cylinders": [2]}
    assert blocked(world, (0.0, 6.0, 3.0)) == {}


def test_what_touches_the_target_from_behind_does_not_block():
    trunk = np.array([[0.45, 0.0, 0.0, 0.0, 0.0, 1.0, 0.2, 5.0]])
    world = World("crash", START, GOAL, cylinders=trunk)
    assert blocked(world, (-6.0, 0.0, 3.0)) == {}
    assert blocked(world, (6.0, 0.0, 3.0)) == {"cylinders": [0]}


def test_an_obstacle_around_the_eye_blocks():
    world = World("ball", START, GOAL, spheres=np.array([[-6.0, 0.0, 2.0, 2.0]]))
    assert blocked(world, (-6.5, 0.5, 2.0)) == {"spheres": [0]}


def test_the_rows_of_boxes_leave_out_the_ground():
    ground, ceiling = [10.0, 0.0, -0.5, 60.0, 60.0, 1.0, 0.0], [10.0, 0.0, 3.0, 30.0, 9.0, 0.1, 0.3]
    world = World("room", START, GOAL, boxes=np.array([ground, ceiling]))
    assert blocked(world, (0.0, 0.1, 24.0)) == {"boxes": [0]}
    assert blocked(world, (0.0, 0.1, -8.0)) == {}


def test_large_triangles_block_where_the_line_crosses_and_small_ones_nearby():
    large = [-20.0, -20.0, 4.0, 20.0, -20.0, 4.0, 0.0, 20.0, 4.0]
    small = [[x, 0.2, 5.0, x + 0.1, 0.2, 5.0, x, 0.3, 5.0] for x in (0.0, 2.0)]
    world = World("mesh", START, GOAL, triangles=np.array([large, *small]))
    assert blocked(world, (0.0, 0.1, 9.0)) == {"triangles": [0, 1]}
    assert blocked(world, (0.0, 0.1, 3.0)) == {}


def test_every_line_through_a_dense_scene_agrees_with_distances_along_it():
    world = scene("verticals", seed=0)
    targets, eyes = np.random.default_rng(0).uniform((3.0, -15.0, 1.0), (40.0, 15.0, 5.0), (2, 40, 3))
    sight = SightLines(world)
    for eye, target in zip(eyes, targets, strict=True):
        found = sight.blocked_by(eye, target[None], np.array([0.1]))["cylinders"]
        line = eye + np.linspace(0.0, 1.0, 500)[:, None] * (target - eye)
        is_blocked = bool((world.distance(line) < 0.0).any())
        assert is_blocked <= (len(found) > 0)


def test_a_ceiling_hides_the_drone_from_above_only_and_a_wall_is_none():
    drone, above, beside = np.array([0.0, 0.0, 1.0]), np.array([-3.0, 0.0, 8.0]), np.array([-3.0, 0.0, 1.5])
    ceiling, wall = [0.0, 0.0, 3.0, 20.0, 20.0, 0.2, 0.0], [-1.5, 0.0, 3.0, 0.2, 20.0, 8.0, 0.0]
    quad = np.array([[-9.0, -9.0, 4.0], [9.0, -9.0, 4.0], [0.0, 20.0, 4.0]])
    room = SightLines(World("room", np.zeros(3), np.ones(3), boxes=np.array([ceiling, wall])))
    assert room.ceiling(above, drone) == pytest.approx(2.9)
    assert room.ceiling(beside, drone) is None
    mesh = SightLines(World("mesh", np.zeros(3), np.ones(3), triangles=quad.reshape(1, 9)))
    assert mesh.ceiling(above, drone) == pytest.approx(4.0)
    assert mesh.ceiling(beside, drone) is None and mesh.ceiling(drone, above) is None
