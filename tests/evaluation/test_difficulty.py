import math

import numpy as np
import pytest

from aero_viz.evaluation.difficulty import measure_difficulty
from aero_viz.evaluation.world_info import examine_world
from aero_viz.scenes import World, scene

START, GOAL = np.array([0.0, 0.0, 0.0]), np.array([10.0, 0.0, 0.0])


def world(*boxes: tuple[float, ...]) -> World:
    return World("test", START, GOAL, boxes=np.reshape(boxes, (-1, 7)))


def test_free_space_is_the_easiest():
    found = measure_difficulty(world())
    assert found is not None
    assert found.to_dict() == {
        "traversability_obstruction": 0.5, "view_occlusion": 0.0, "angle_over_length": 0.0, "guide_length": 10.0,
        "difficulty": 0.5,
    }  # fmt: skip


def test_the_obstruction_of_a_tunnel_follows_from_its_width():
    walls = [(5.0, side * 1.5, 0.0, 20.0, 1.0, 4.0, 0.0) for side in (-1.0, 1.0)]
    walls += [(5.0, 0.0, side * 1.5, 20.0, 4.0, 1.0, 0.0) for side in (-1.0, 1.0)]
    found = measure_difficulty(world(*walls))
    assert found is not None
    # Balls of 1 m less 0.15 m on the axis; those beside it are smaller, so that the value is a lower bound.
    assert found.traversability_obstruction == pytest.approx(4.0 / (2.0 * 0.85), rel=0.15)
    assert found.traversability_obstruction >= 0.99 * 4.0 / (2.0 * 0.85)
    assert found.angle_over_length == 0.0


def test_a_wall_behind_the_goal_occludes_the_view_by_its_distance():
    found = measure_difficulty(world((12.5, 0.0, 0.0, 1.0, 20.0, 20.0, 0.0)))
    assert found is not None
    expected = []
    for x in [*np.arange(0.4, 10.0, 0.4), 10.0]:
        rays = [(weight, (12.0 - x) / math.cos(math.radians(angle))) for angle, weight in
                ((0.0, 0.55), (15.0, 0.3), (22.5, 0.1), (30.0, 0.05))]  # fmt: skip
        expected.append(sum(weight * 4.0 / distance for weight, distance in rays if distance <= 4.0))
    assert found.view_occlusion == pytest.approx(np.mean(expected), rel=0.05)


def test_a_detour_turns_the_guide():
    found = measure_difficulty(world((5.0, 0.0, 0.0, 0.2, 6.0, 30.0, 0.0)))
    assert found is not None
    # Two pieces around the edge of a wall that reaches 3 m to the side, at least 0.25 m from it.
    assert 2.0 * math.hypot(5.0, 3.25) - 0.1 < found.guide_length < 2.0 * math.hypot(5.0, 3.25) + 1.0
    turn = 2.0 * math.atan2(3.25, 5.0)
    one_corner = math.expm1(2.0 * turn / math.pi) / found.guide_length
    assert 0.6 * one_corner < found.angle_over_length < 1.2 * one_corner


def test_no_guide_leads_out_of_a_closed_room():
    sides = [(0.0, y, 0.0, 8.0, 0.5, 20.0, 0.0) for y in (-4.0, 4.0)]
    sides += [(x, 0.0, 0.0, 0.5, 8.0, 20.0, 0.0) for x in (-4.0, 4.0)]
    assert measure_difficulty(world(*sides)) is None


def test_a_goal_at_the_start_has_no_difficulty():
    there = World("test", START, START, spheres=np.array([[3.0, 0.0, 0.0, 1.0]]))
    assert measure_difficulty(there) is None
    assert "unknown: the goal is the start" in examine_world(there, radius=0.25).format_table()


def test_more_trees_are_harder_and_the_result_repeats():
    sparse, dense = (measure_difficulty(scene("forest", count=count, seed=3)) for count in (30, 300))
    assert sparse is not None
    assert dense is not None
    assert dense.traversability_obstruction > 1.1 * sparse.traversability_obstruction
    assert dense.view_occlusion > 1.1 * sparse.view_occlusion
    assert measure_difficulty(scene("forest", count=30, seed=3)) == sparse
