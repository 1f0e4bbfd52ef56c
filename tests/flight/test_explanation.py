import math
import re

import numpy as np
import pytest

from aero_planner import PlannerConfig
from aero_viz.errors import UserError
from aero_viz.flight import FlightRules, fly
from aero_viz.flight.explanation import explain, refuse_impossible
from aero_viz.scenes import World
from aero_viz.sensors import LidarModel

RULES = FlightRules()
GROUND = [5.0, 0.0, -0.5, 60.0, 60.0, 1.0, 0.0]


def world(**tables) -> World:
    goal, bounds = tables.pop("goal", (9.0, 0.0, 2.0)), tables.pop("bounds", None)
    tables = {key: np.array(rows, dtype=float) for key, rows in tables.items()}
    return World("test", np.array([0.0, 0.0, 2.0]), np.array(goal), bounds=bounds, mission=None, **tables)


@pytest.mark.parametrize(
    ("tables", "sentence"),
    [
        ({"spheres": [[5, 5, 2, 1], [0, 0, 2.5, 1]]},
         'The start is inside an obstacle, 0.500 m deep in sphere 1, at (0, 0, 2).'),
        ({"spheres": [[0, 0, 3.2, 1]]},
         'The start is 0.200 m from sphere 0, closer than the radius of 0.25 m, at (0, 0, 2).'),
    ],
)  # fmt: skip
def test_a_start_in_an_obstacle_is_reported_as_a_collision(tables, sentence):
    result = fly(world(**tables), lidar=LidarModel("small", points_per_sweep=100))
    assert (result.reason, result.flight_time_s, result.explanation) == ("collision", 0.0, sentence)


@pytest.mark.parametrize(
    ("reason", "clearance", "sentence"),
    [
        ("arrived", 1.0, None),
        ("collision", 0.21, "After 3.00 s the drone was 0.210 m from the ground, closer than the radius of 0.25 m, "
         "at (3, 0, 0.2)."),
        ("stall", 1.0, "The drone moved by less than 1 m within 5 s; it stalled at (3, 0, 0.2), "
         "6.3 m from the goal."),
        ("out_of_bounds", 1.0, "The drone left the world's bounds, x -35 to 45, y -40 to 40, z -11 to 12, "
         "at (3, 0, 0.2)."),
        ("timeout", 1.0, "The time limit of 60 s expired at (3, 0, 0.2), 6.3 m from the goal."),
        (None, 1.0, "The flight was not over after 3.00 s, at (3, 0, 0.2), 6.3 m from the goal."),
    ],
)  # fmt: skip
def test_every_outcome_has_its_sentence(reason, clearance, sentence):
    place, goal = np.array([3.0, 0.0, 0.2]), np.array([9.0, 0.0, 2.0])
    explanation = explain(reason, world(boxes=[GROUND]), place, time=3.0, clearance=clearance, goal=goal, rules=RULES)
    assert explanation == sentence


def test_a_collision_names_the_obstacle():
    wall = world(boxes=[GROUND, [1.0, 0.0, 2.0, 0.2, 40.0, 12.0, 0.0]])
    config = PlannerConfig.preset("fast-cpu").replace({"costs.penalty": 0.0, "costs.soft_weight": 0.0})
    config = config.replace({"candidates.prefer_safe": False, "candidates.safe_clearance": 0.0})
    # The LiDAR sees the ground, but not the wall.
    result = fly(wall, config=config, lidar=LidarModel("down", elevation_min=-90.0, elevation_max=-80.0))
    assert result.reason == "collision" and result.explanation is not None
    assert "m from box 1, closer than" in result.explanation


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"bounds": [[1, -1, 0], [9, 5, 5]]}, r"start \(0, 0, 2\) lies outside the bounds"),
        (
            {"goal": (5000, 0, 2)},
            r"5000 m away and cannot be reached at 7 m/s within the time limit of 60 s; give a nearer goal",
        ),
    ],
)
def test_impossible_flights_are_refused(tables, message):
    for refuse in (
        lambda: refuse_impossible(world(**tables), rules=RULES, speed_limit=7.0),
        lambda: fly(world(**tables)),
    ):
        with pytest.raises(UserError, match=message):
            refuse()


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"spheres": [[9, 0, 2.5, 1]]}, r"The goal \(9, 0, 2\) lies inside an obstacle .* 0\.50 m deep in sphere 0"),
        ({"bounds": [[-1, -1, 0], [5, 5, 5]]}, r"The goal \(9, 0, 2\) lies outside the bounds .* x -1 to 5"),
    ],
)
def test_a_goal_that_no_drone_can_reach_is_refused_where_flights_must_arrive_and_named_where_one_ends(tables, message):
    place = world(**tables)
    with pytest.raises(UserError, match=message + ".*give another goal"):
        refuse_impossible(place, rules=RULES, speed_limit=7.0)
    refuse_impossible(place, rules=RULES, speed_limit=7.0, must_arrive=False)
    ending = explain("stall", place, (5.0, 0.0, 2.0), time=9.0, clearance=1.0, goal=place.goal, rules=RULES)
    said = message + r".*, so the drone flies as near to it as is safe\. .* stalled at \(5, 0, 2\), 4\.0 m"
    assert ending is not None and re.match(said, ending)


def test_a_far_goal_is_refused_depending_on_speed_and_time():
    far = world(goal=(500, 0, 2))
    refuse_impossible(far, rules=RULES, speed_limit=8.4)
    refuse_impossible(far, rules=FlightRules(time_limit=100.0), speed_limit=7.0)
    refuse_impossible(world(), rules=FlightRules(time_limit=0.1), speed_limit=7.0)  # a part of a flight
    with pytest.raises(UserError, match="500 m away"):
        refuse_impossible(far, rules=RULES, speed_limit=8.2)


def test_nearest_names_kind_and_row():
    mixed = world(boxes=[GROUND, [3, 3, 1, 1, 1, 2, 0]], cylinders=[[6, 0, 0, 0, 0, 1, 0.5, 4]], spheres=[[0, 9, 2, 1]])
    assert mixed.nearest([6.0, 1.0, 3.0]) == (pytest.approx(0.5), "cylinder 0")
    assert mixed.nearest([3.0, 3.0, 2.5]) == (pytest.approx(0.5), "box 1")
    assert mixed.nearest([-5.0, 0.0, 1.0]) == (pytest.approx(1.0), "the ground")
    assert mixed.nearest([0.0, 9.0, 2.0]) == (pytest.approx(-1.0), "sphere 0")
    assert world().nearest([0.0, 0.0, 0.0]) == (math.inf, "nothing")
