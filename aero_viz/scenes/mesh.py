"""Worlds as triangle meshes for drawing. Distances and rays use the exact primitives instead."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_viz.scenes.world import World

_SIDES = 8
_RINGS = 4


@dataclass(frozen=True, eq=False)
class Mesh:
    """Vertices [m], float32 [v, 3], world frame, and faces, int32 [f, 3], counter-clockwise seen from outside."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Instances:
    """Copies of one mesh, each moved by x -> axes x + position."""

    shape: Mesh
    positions: NDArray[np.float64]
    """[m], shape [n, 3], world frame."""
    axes: NDArray[np.float64]
    """Orthogonal columns whose lengths are the scales, shape [n, 3, 3]."""

    @property
    def scales(self) -> NDArray[np.float32]:
        """Factors along the axes of the shape, shape [n, 3]."""
        return np.linalg.norm(self.axes, axis=1).astype(np.float32)

    @property
    def rotations(self) -> NDArray[np.float64]:
        """Rotation matrices, shape [n, 3, 3]."""
        return self.axes / np.linalg.norm(self.axes, axis=1, keepdims=True)

    def below(self, height: float) -> Instances:
        """Return the same copies without what is above a height [m].

        Copies that stand are cut there. Others, and round ones, are removed if their middle is above it: they shrink to
        a point.
        """
        low, high = self.shape.vertices[:, 2].min(), self.shape.vertices[:, 2].max()
        upward, center = self.axes[:, 2, 2], self.positions[:, 2]
        stands = np.abs(upward) > 0.5 * np.linalg.norm(self.axes[:, :, 2], axis=1)
        stands &= self.shape is not SHAPES["spheres"]
        at = np.clip((height - center) / np.where(stands, upward, 1.0), low, high)  # along the axis of the shape
        begin, end = np.where(upward > 0.0, (np.full_like(at, low), at), (at, np.full_like(at, high)))
        share = np.where(stands, (end - begin) / (high - low), center + 0.5 * (low + high) * upward <= height)
        axes = self.axes.copy()
        axes[:, :, 2] *= np.maximum(share, 1e-6)[:, None]
        axes[share <= 0.0] *= 1e-6
        offset = np.where(stands, begin - low * share, 0.0)
        return Instances(self.shape, self.positions + offset[:, None] * self.axes[:, :, 2], axes)

    def merged(self, rows: NDArray[np.int64] | slice = slice(None)) -> Mesh:
        """Return one mesh of all copies, or of some."""
        vertices = np.einsum("nij,vj->nvi", self.axes[rows], self.shape.vertices) + self.positions[rows, None]
        first = np.arange(len(vertices)) * len(self.shape.vertices)
        faces = self.shape.faces[None] + first[:, None, None]
        return Mesh(vertices.reshape(-1, 3).astype(np.float32), faces.reshape(-1, 3).astype(np.int32))


def world_instances(world: World) -> dict[str, Instances]:
    """Return the solids of a world by kind: "cylinders", "boxes" (without the ground) and "spheres".

    Absent kinds are left out. The copies are in the order of the rows of the world.
    """
    kinds = {
        "cylinders": Instances(SHAPES["cylinders"], world.cylinders[:, :3], _cylinder_axes(world.cylinders)),
        "boxes": _boxes(world.boxes[~world.ground]),
        "spheres": Instances(SHAPES["spheres"], world.spheres[:, :3], np.eye(3) * world.spheres[:, 3, None, None]),
    }
    return {kind: instances for kind, instances in kinds.items() if len(instances.positions)}


def world_meshes(world: World) -> dict[str, Mesh]:
    """Return one merged mesh per kind of obstacle.

    Keys are "cylinders", "boxes" (without the ground), "ground", "spheres" and "triangles"; absent kinds are left out.
    """
    corners = world.triangles.reshape(-1, 3).astype(np.float32)
    parts = {kind: instances.merged() for kind, instances in world_instances(world).items()}
    parts["ground"] = box_mesh(world.boxes[world.ground])
    parts["triangles"] = Mesh(corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3))
    return {kind: mesh for kind, mesh in parts.items() if len(mesh.faces)}


def box_mesh(table: NDArray[np.float64]) -> Mesh:
    """Return one mesh of boxes, each given by its centre [m], size [m] and yaw [rad], shape [n, 7]."""
    return _boxes(table).merged()


def joined_mesh(parts: list[Mesh]) -> Mesh:
    """Return one mesh of several."""
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    faces = [part.faces + np.int32(offset) for part, offset in zip(parts, offsets, strict=True)]
    return Mesh(np.concatenate([part.vertices for part in parts]), np.concatenate(faces))


def _boxes(table: NDArray[np.float64]) -> Instances:
    return Instances(SHAPES["boxes"], table[:, :3], _box_axes(table))


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


SHAPES: dict[str, Mesh] = {"cylinders": _unit_cylinder(), "boxes": _unit_box(), "spheres": _unit_sphere()}
"""Unit shape of each kind of solid: radius, height and edge lengths are 1."""
