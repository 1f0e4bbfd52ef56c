"""Synthetic worlds: primitives, JSON, seeded generators, meshes for drawing."""

from __future__ import annotations

from aero_viz.scenes.generators import SCENES, forest, inclines, scene, verticals
from aero_viz.scenes.mesh import Mesh
from aero_viz.scenes.world import World

__all__ = ["SCENES", "Mesh", "World", "forest", "inclines", "scene", "verticals"]
