"""Worlds as triangle meshes for drawing. Distances and rays use the exact primitives instead."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_viz.scenes.world import World

__all__ = ["Mesh", "box_mesh", "world_meshes"]

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
    ground, corners = world.ground, world.triangles.reshape(-1, 3).astype(np.float32)
    parts = {
        "cylinders": _instances(_unit_cylinder(), world.cylinders, _cylinder_axes(world.cylinders)),
        "boxes": box_mesh(world.boxes[~ground]),
        "ground": box_mesh(world.boxes[ground]),
        "spheres": _instances(_unit_sphere(), world.spheres, np.eye(3) * world.spheres[:, 3, None, None]),
        "triangles": Mesh(corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3)),
    }
    return {kind: mesh for kind, mesh in parts.items() if len(mesh.faces)}


def box_mesh(table: NDArray[np.float64]) -> Mesh:
    """Return one mesh of boxes, each given by its centre [m], size [m] and yaw [rad], shape [n, 7]."""
    return _instances(_unit_box(), table, _box_axes(table))


def _instances(shape: Mesh, table: NDArray[np.float64], axes: NDArray[np.float64]) -> Mesh:
    """Merge n copies of `shape`, transformed by x -> axes x + the first three columns of the table; axes [n, 3, 3]."""
    vertices = np.einsum("nij,vj->nvi", axes, shape.vertices) + table[:, None, :3]
    first = np.arange(len(table)) * len(shape.vertices)
    faces = shape.faces[None] + first[:, None, None]
    return Mesh(vertices.reshape(-1, 3).astype(np.float32), faces.reshape(-1, 3).astype(np.int32))


def _cylinder_axes(table: NDArray[np.float64]) -> NDArray[Any]:
    axis = table[:, 3:6]
    helper = np.where(np.abs(axis[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    u = np.cross(helper, axis)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(axis, u)
    radius, height = table[:, 6:7], table[:, 7:8]
    return np.stack([radius * u, radius * v, height * axis], axis=-1)


def _box_axes(table: NDArray[np.float64]) -> NDArray[np.float64]:
    c, s, zeros, ones = np.cos(table[:, 6]), np.sin(table[:, 6]), np.zeros(len(table)), np.ones(len(table))
    rotation = np.stack([c, -s, zeros, s, c, zeros, zeros, zeros, ones], axis=1).reshape(-1, 3, 3)
    return rotation * table[:, None, 3:6]


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
