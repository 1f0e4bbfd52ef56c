import numpy as np
import pytest

from aero_viz.flight.explanation import world_problem
from aero_viz.scenes import World, scene
from aero_viz.scenes.course import GATES, OPENING

SEEDS = range(6)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_mission_leads_through_every_gate(seed: int):
    world = scene("course", seed=seed)
    *gates, goal = world.route.waypoints
    assert len(gates) == GATES and goal.stop and not any(gate.stop for gate in gates)
    assert world_problem(world) is None and (np.diff([gate.position[0] for gate in gates]) > 5.0).all()
    for gate, bars in zip(gates, np.split(world.boxes[: 4 * GATES], GATES), strict=True):
        centre, yaw = np.array(gate.position), bars[0, 6]
        along, across = np.array([np.cos(yaw), np.sin(yaw), 0.0]), np.array([-np.sin(yaw), np.cos(yaw), 0.0])
        run = centre + np.linspace(-4.0, 4.0, 81)[:, None] * along
        assert world.distance(run).min() > 1.0  # straight through, also for a drone with the default margins
        edge = 0.5 * OPENING
        for beside in (edge * across, -edge * across, np.array([0, 0, edge]), np.array([0, 0, -edge])):
            assert (
                World.distance(world, centre + 0.9 * beside)[0] > 0.0 > World.distance(world, centre + 1.1 * beside)[0]
            )
        assert gate.radius == edge  # so that a drone that flies past outside does not pass


@pytest.mark.parametrize("seed", SEEDS)
def test_a_course_lies_on_the_ground_in_a_forest(seed: int):
    world = scene("course", seed=seed)
    assert world.ground_height == 0.0 and len(world.cylinders) > 200
    assert np.abs(world.cylinders[:, 1]).max() < 40.0 and np.abs(world.goal[1]) < 20.0


def test_a_course_is_written_and_read_with_its_mission(tmp_path):
    world = scene("course", seed=3)
    world.save(tmp_path / "course.json")
    assert World.load(tmp_path / "course.json").mission == world.mission
    assert scene("course", seed=3).mission == world.mission != scene("course", seed=4).mission
