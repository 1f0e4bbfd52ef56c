"""Worlds as triangle meshes for drawing. Distances and rays use the exact primitives instead."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_viz.scenes.world import World

__all__ = ["Mesh", "world_meshes"]

_SIDES = 8
_RINGS = 4


@dataclass(frozen=True, eq=False)
class Mesh:
    """Vertices [m], float32 [v, 3], world frame, and faces, int32 [f, 3], counter-clockwise seen from outside."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]


def world_meshes(world: World) -> dict[str, Mesh]:
    """Return one merged mesh per kind of obstacle.

    Keys are "cylinders", "boxes" (without the ground), "ground", "spheres" and "triangles"; absent kinds are left out.
    """
    ground = world.ground
    parts = {
        "cylinders": _instances(_unit_cylinder(), *_cylinder_frames(world.cylinders)),
        "boxes": _instances(_unit_box(), *_box_frames(world.boxes[~ground])),
        "ground": _instances(_unit_box(), *_box_frames(world.boxes[ground])),
        "spheres": _instances(_unit_sphere(), *_sphere_frames(world.spheres)),
        "triangles": _soup(world.triangles),
    }
    return {kind: mesh for kind, mesh in parts.items() if len(mesh.faces)}


def _instances(shape: Mesh, linear: NDArray[np.float64], offset: NDArray[np.float64]) -> Mesh:
    """Merge n copies of `shape`, transformed by x -> linear x + offset, with linear [n, 3, 3] and offset [n, 3]."""
    vertices = np.einsum("nij,vj->nvi", linear, shape.vertices) + offset[:, None, :]
    first = np.arange(len(offset)) * len(shape.vertices)
    faces = shape.faces[None] + first[:, None, None]
    return Mesh(vertices.reshape(-1, 3).astype(np.float32), faces.reshape(-1, 3).astype(np.int32))


def _soup(triangles: NDArray[np.float64]) -> Mesh:
    corners = triangles.reshape(-1, 3).astype(np.float32)
    return Mesh(corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3))


def _cylinder_frames(table: NDArray[np.float64]) -> tuple[NDArray[Any], NDArray[np.float64]]:
    axis = table[:, 3:6]
    helper = np.where(np.abs(axis[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    u = np.cross(helper, axis)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(axis, u)
    radius, height = table[:, 6:7], table[:, 7:8]
    return np.stack([radius * u, radius * v, height * axis], axis=-1), table[:, :3]


def _box_frames(table: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    c, s, zeros, ones = np.cos(table[:, 6]), np.sin(table[:, 6]), np.zeros(len(table)), np.ones(len(table))
    rotation = np.stack([c, -s, zeros, s, c, zeros, zeros, zeros, ones], axis=1).reshape(-1, 3, 3)
    return rotation * table[:, None, 3:6], table[:, :3]


def _sphere_frames(table: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return np.eye(3)[None] * table[:, 3, None, None], table[:, :3]


def _unit_box() -> Mesh:
    vertices = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)], dtype=np.float32)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return Mesh(vertices, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], dtype=np.int32))


def _surface_of_revolution(profile: list[tuple[float, float]]) -> Mesh:
    """Revolve (radius, z) pairs, from the bottom up, around z; the first and the last pair are poles of radius 0."""
    angle = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
    rings = [[(r * np.cos(a), r * np.sin(a), z) for a in angle] for r, z in profile[1:-1]]
    poles = [(0.0, 0.0, profile[0][1]), (0.0, 0.0, profile[-1][1])]
    vertices = np.array(poles + [v for ring in rings for v in ring], dtype=np.float32)
    faces = []
    for j in range(_SIDES):
        k = (j + 1) % _SIDES
        for lower in range(len(rings) - 1):
            a, b = 2 + lower * _SIDES, 2 + (lower + 1) * _SIDES
            faces += [(a + j, a + k, b + k), (a + j, b + k, b + j)]
        top = 2 + (len(rings) - 1) * _SIDES
        faces += [(0, 2 + k, 2 + j), (1, top + j, top + k)]
    return Mesh(vertices, np.array(faces, dtype=np.int32))


def _unit_cylinder() -> Mesh:
    # The rims appear twice, so that shading by vertex normals keeps the edge sharp.
    return _surface_of_revolution([(0.0, 0.0), (1.0, 0.0), (1.0, 0.0), (1.0, 1.0), (1.0, 1.0), (0.0, 1.0)])


def _unit_sphere() -> Mesh:
    angle = np.pi * (np.arange(_RINGS + 1) / _RINGS - 0.5)
    return _surface_of_revolution([(float(np.cos(a)), float(np.sin(a))) for a in angle])
