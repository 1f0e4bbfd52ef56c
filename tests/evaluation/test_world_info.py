"""Reports about worlds."""

import dataclasses

import numpy as np

from aero_viz.evaluation.world_info import WorldInfo, examine_world
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


def test_the_region_in_which_a_path_was_searched_is_stated():
    """It is around start, goal and obstacles, and does not lead around the only one."""
    content = {"name": "g", "start": [0, 0, 2], "goal": [6, 0, 2], "cylinders": [[3, 0, 0, 0, 0, 1, 0.3, 5]]}
    info = examine_world(World.from_dict(content), radius=0.25)
    lines = info.format_table().splitlines()
    row = next(i for i, line in enumerate(lines) if line.startswith("path for a radius of 0.25 m"))
    assert lines[row].endswith(" no")
    assert lines[row + 1].split(maxsplit=1) == ["searched", "0.00, 0.00, 0.50 to 6.00, 0.00, 3.50"]
    assert info.to_dict()["searched"] == [[0.0, 0.0, 0.5], [6.0, 0.0, 3.5]]


def test_places_are_plain_values():
    content = report([GROUND]).to_dict()
    assert content["start"] == [0.0, 0.0, 2.0] and np.shape(content["bounds"]) == (2, 3)
