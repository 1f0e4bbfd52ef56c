"""Reports about worlds."""

import dataclasses

import numpy as np

from aero_viz.evaluation.world_info import WorldInfo
from aero_viz.scenes import World

GROUND = [0.0, 0.0, -0.5, 80.0, 80.0, 1.0, 0.0]


def report(boxes: list[list[float]]) -> WorldInfo:
    cylinders = [[5.0, 0, 0, 0, 0, 1, 0.5, 8]]
    content = {"name": "test", "start": [0, 0, 2], "goal": [20, 0, 2], "cylinders": cylinders, "boxes": boxes}
    return WorldInfo(World.from_dict(content), 0.25, {"passable": True, "difficulty": None})


def test_the_ground_is_no_obstacle():
    for walls, text in (([], "1 cylinder"), ([[9.0, 3, 2, 1, 1, 4, 0]], "1 cylinder, 1 box")):
        info = report([GROUND, *walls])
        row = next(line for line in info.format_table().splitlines() if line.startswith("obstacles"))
        assert row.split(maxsplit=1)[1] == text
        assert info.to_dict()["boxes"] == 1 + len(walls), "JSON counts what the file of the world holds"
    assert "ground                       0.00 m" in info.format_table()


def test_a_world_in_which_no_flight_can_arrive_says_why():
    info = report([GROUND])
    assert info.to_dict()["problem"] is None and "no flight" not in info.format_table()
    inside = WorldInfo(dataclasses.replace(info.world, goal=np.array([5.0, 0.0, 2.0])), 0.25, info.about)
    assert "no flight can arrive         The goal (5, 0, 2) lies inside an obstacle" in inside.format_table()
    assert "give another goal" in inside.to_dict()["problem"]


def test_places_are_plain_values():
    content = report([GROUND]).to_dict()
    assert content["start"] == [0.0, 0.0, 2.0] and np.shape(content["bounds"]) == (2, 3)
