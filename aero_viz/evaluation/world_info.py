"""A report about a world: its obstacles, whether a path exists, and its difficulty."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from aero_viz.evaluation.difficulty import describe_world
from aero_viz.flight.explanation import world_problem
from aero_viz.scenes import World
from aero_viz.scenes.clearance_grid import search_box
from aero_viz.text_table import format_table

_SINGULAR = {"cylinders": "cylinder", "boxes": "box", "spheres": "sphere", "triangles": "triangle"}


@dataclass(frozen=True)
class WorldInfo:
    """Description of a world, made without flying."""

    world: World
    radius: float
    """Radius of the drone [m]."""
    about: dict[str, Any]
    """See `describe_world`."""

    def to_dict(self) -> dict[str, Any]:
        """Return the report as plain values for JSON."""
        world = self.world
        counts = {name: len(getattr(world, name)) for name in ("cylinders", "boxes", "spheres", "triangles")}
        places = {name: getattr(world, name).tolist() for name in ("start", "goal", "bounds")}
        searched = [corner.tolist() for corner in search_box(world.standing())]
        if world.mission is not None:
            places["mission"] = world.mission.to_dict()
        return {"name": world.name, **counts, "ground_height": world.ground_height, **places, "radius": self.radius,
                "problem": world_problem(world), "searched": searched, **self.about}  # fmt: skip

    def format_table(self) -> str:
        """Return the report as text for a terminal."""
        about, content = self.about, self.to_dict()
        counts = {plural: content[plural] for plural in _SINGULAR}
        counts["boxes"] -= int(self.world.ground.sum())  # the ground has a row of its own
        named = [f"{n} {_SINGULAR[plural] if n == 1 else plural}" for plural, n in counts.items() if n]
        obstacles = ", ".join(named) or "none"
        ground = content["ground_height"]
        way = float(np.linalg.norm(self.world.goal - self.world.start))
        rows = [
            ["world", self.world.name],
            ["obstacles", obstacles],
            ["ground", "none known" if ground is None else f"{ground:.2f} m"],
            ["start", _position(content["start"])],
            ["goal", f"{_position(content['goal'])}, {way:.1f} m away"],
            *self._mission_rows(),
            ["airspace", f"{_position(content['bounds'][0])} to {_position(content['bounds'][1])}"],
            [f"path for a radius of {self.radius:g} m", "yes" if about["passable"] else "no"],
            ["searched", f"{_position(content['searched'][0])} to {_position(content['searched'][1])}"],
        ]
        if content["problem"] is not None:
            rows.append(["no flight can arrive", content["problem"]])
        if about["difficulty"] is None:
            reason = "no guide from start to goal was found" if way else "the goal is the start"
            return format_table([*rows, ["difficulty", f"unknown: {reason}"]])
        rows += [
            ["guide", f"{about['guide_length']:.1f} m"],
            ["traversability obstruction", f"{about['traversability_obstruction']:.2f}, the least of 8 corridors"],
            ["view occlusion", f"{about['view_occlusion']:.2f}"],
            ["angle over length", f"{about['angle_over_length']:.2g} /m"],
            ["difficulty", f"{about['difficulty']:.2f}, the sum of the three (FlightBench)"],
        ]
        return format_table(rows)

    def _mission_rows(self) -> list[list[str]]:
        mission = self.world.mission
        if mission is None:
            return []
        return [["mission", f"{len(mission)} waypoints, {mission.length(self.world.start):.1f} m in all"]]


def examine_world(world: World, *, radius: float) -> WorldInfo:
    """Return the report about a world for a drone of this radius [m]."""
    return WorldInfo(world, radius, describe_world(world, radius=radius))


def _position(values: list[float]) -> str:
    return ", ".join(f"{value:.2f}" for value in values)
