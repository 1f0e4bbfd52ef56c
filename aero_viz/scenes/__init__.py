"""Worlds: primitives and triangles, JSON files, seeded generators, maps from files, meshes for drawing."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aero_planner.lazy_import import lazy_exports

if TYPE_CHECKING:
    from aero_viz.scenes.generators import SCENES, SceneKind, density, forest, inclines, scene, verticals
    from aero_viz.scenes.maps import load_map
    from aero_viz.scenes.mesh import Instances, Mesh, world_instances, world_meshes
    from aero_viz.scenes.rooms import double_wall_trap, pillars, random_clutter, wall
    from aero_viz.scenes.sight import SightLines
    from aero_viz.scenes.world import World

__all__ = [
    "SCENES",
    "Instances",
    "Mesh",
    "SceneKind",
    "SightLines",
    "World",
    "density",
    "double_wall_trap",
    "forest",
    "inclines",
    "load_map",
    "pillars",
    "random_clutter",
    "scene",
    "verticals",
    "wall",
    "world_instances",
    "world_meshes",
]

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "generators": ("SCENES", "SceneKind", "density", "forest", "inclines", "scene", "verticals"),
        "maps": ("load_map",),
        "mesh": ("Instances", "Mesh", "world_instances", "world_meshes"),
        "rooms": ("double_wall_trap", "pillars", "random_clutter", "wall"),
        "sight": ("SightLines",),
        "world": ("World",),
    },
)
