"""Export of worlds for other programs: the surface as points, or the world as JSON."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aero_planner.output_files import whole_file
from aero_viz.errors import UserError
from aero_viz.scenes import World
from aero_viz.scenes.primitives import primitive_bounds

FORMATS = (".pcd", ".npy", ".ply", ".json")
_BURIED_DEPTH = 1e-6
"""Points that lie deeper than this in another primitive [m] are left out."""
_MAX_POINTS = 100_000_000

Points = NDArray[np.float64]


def surface_points(world: World, *, spacing: float = 0.1) -> Points:
    """Return points on the surfaces of a world [n, 3] [m], world frame, evenly spaced and the same in every call.

    Points inside other primitives are left out; of the ground there is only the top.

    Args:
        world: the world.
        spacing: distance between neighbouring points [m].

    Raises:
        UserError: the spacing is not positive or gives more than 100 million points.
    """
    if not 0.0 < spacing < math.inf:
        raise UserError(f"The spacing is {spacing!r} m; it must be positive.")
    _check_point_count(world, spacing)
    parts = [_cylinder(row, spacing) for row in world.cylinders]
    parts += [_box(row, spacing, only_top=ground) for row, ground in zip(world.boxes, world.ground, strict=True)]
    parts += [_sphere(row, spacing) for row in world.spheres]
    parts += [_triangle(row, spacing) for row in world.triangles]
    if not parts:
        return np.zeros((0, 3))
    points = np.concatenate(parts)
    return points[~_is_buried(points, world)]


def export_world(world: World, path: str | Path, *, spacing: float = 0.1) -> int:
    """Write a world to a file and return the number of points written, 0 for JSON.

    Args:
        world: the world.
        path: file whose suffix gives the format: .pcd (binary), .ply (binary, little endian) or .npy for
            `surface_points` [n, 3] as float32, or .json for the world itself.
        spacing: distance between neighbouring points [m].

    Raises:
        UserError: the format is unknown, the spacing is out of range, or the file cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise UserError(f"Cannot export to {path}: its name must end with one of {', '.join(FORMATS)}.")
    if suffix == ".json":
        world.save(path)
        return 0
    points = surface_points(world, spacing=spacing).astype("<f4")
    try:
        with whole_file(path, alone=True) as partial, partial.open("wb") as file:
            if suffix == ".npy":
                np.save(file, points)
            else:
                header = _pcd_header(len(points)) if suffix == ".pcd" else _ply_header(len(points))
                file.write(header.encode() + points.tobytes())
    except OSError as error:
        raise UserError(f"Cannot write {path}: {error.strerror or error}.") from error
    return len(points)


def _pcd_header(count: int) -> str:
    return (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA binary\n"
    )


def _ply_header(count: int) -> str:
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    return f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n{properties}end_header\n"


def _check_point_count(world: World, spacing: float) -> None:
    radius, height = world.cylinders[:, 6], world.cylinders[:, 7]
    sx, sy, sz = world.boxes[:, 3:6].T
    area = 2.0 * np.pi * np.sum(radius * (radius + height)) + 4.0 * np.pi * np.sum(world.spheres[:, 3] ** 2)
    area += np.sum(np.where(world.ground, sx * sy, 2.0 * (sx * sy + sy * sz + sz * sx)))
    a, b, c = np.split(world.triangles, 3, axis=1)
    area += 0.5 * np.sum(np.linalg.norm(np.cross(b - a, c - a), axis=1))
    if area / spacing**2 > _MAX_POINTS:
        raise UserError(
            f"A spacing of {spacing:g} m gives {area / spacing**2:.2g} points; "
            f"use at least {math.sqrt(area / _MAX_POINTS):.2g} m."
        )


def _centres(length: float, spacing: float) -> Points:
    """Return the centres of equal parts of [0, length] that are at most `spacing` long."""
    count = max(1, math.ceil(length / spacing - 1e-9))
    return (np.arange(count) + 0.5) * length / count


def _ring(radius: float, height: float, spacing: float, *, shift: bool) -> Points:
    count = max(3, math.ceil(2.0 * math.pi * radius / spacing - 1e-9))
    angle = 2.0 * np.pi * (np.arange(count) + (0.5 if shift else 0.0)) / count
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, height)])


def _cylinder(row: Points, spacing: float) -> Points:
    base, axis, radius, height = row[:3], row[3:6], float(row[6]), float(row[7])
    rings = [_ring(radius, z, spacing, shift=bool(i % 2)) for i, z in enumerate(_centres(height, spacing))]
    for z in (0.0, height):
        rings += [_ring(r, z, spacing, shift=False) for r in _centres(radius, spacing)]
    local = np.concatenate(rings)
    helper = np.array([1.0, 0.0, 0.0]) if abs(axis[2]) > 0.9 else np.array([0.0, 0.0, 1.0])
    u = np.cross(helper, axis)
    u /= np.linalg.norm(u)
    return base + local @ np.stack([u, np.cross(axis, u), axis])


def _box(row: Points, spacing: float, *, only_top: bool) -> Points:
    half = 0.5 * row[3:6]
    faces = []
    for axis in range(3):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        a, b = np.meshgrid(_centres(2.0 * half[i], spacing), _centres(2.0 * half[j], spacing), indexing="ij")
        for side in (-1.0, 1.0):
            if only_top and not (axis == 2 and side > 0.0):
                continue
            face = np.empty((a.size, 3))
            face[:, axis] = side * half[axis]
            face[:, i], face[:, j] = a.ravel() - half[i], b.ravel() - half[j]
            faces.append(face)
    c, s = math.cos(row[6]), math.sin(row[6])
    return row[:3] + np.concatenate(faces) @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def _sphere(row: Points, spacing: float) -> Points:
    """Return a Fibonacci lattice: points on a spiral from pole to pole, each with an equal share of the area."""
    count = max(4, math.ceil(4.0 * math.pi * row[3] ** 2 / spacing**2))
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    angle = math.pi * (1.0 + math.sqrt(5.0)) * k
    across = np.sqrt(1.0 - z * z)
    return row[:3] + row[3] * np.column_stack([across * np.cos(angle), across * np.sin(angle), z])


def _triangle(row: Points, spacing: float) -> Points:
    """Return the centres of n^2 equal triangles, which are at most `spacing` apart along the longest side."""
    a, b, c = row.reshape(3, 3)
    count = max(1, math.ceil(max(np.linalg.norm(b - a), np.linalg.norm(c - b), np.linalg.norm(a - c)) / spacing - 1e-9))
    i, j = np.meshgrid(np.arange(count), np.arange(count), indexing="ij")
    upright = np.stack([i, j], axis=-1)[i + j < count] + 1.0 / 3.0
    inverted = np.stack([i, j], axis=-1)[i + j < count - 1] + 2.0 / 3.0
    u, v = (np.concatenate([upright, inverted]) / count).T
    return a + u[:, None] * (b - a) + v[:, None] * (c - a)


def _is_buried(points: Points, world: World) -> NDArray[np.bool_]:
    """Return for each point [n] whether it lies inside a primitive. Only points in its bounding box are checked."""
    buried = np.zeros(len(points), dtype=bool)
    order = np.argsort(points[:, 0], kind="stable")
    x = points[order, 0]
    lower, upper = primitive_bounds(world.cylinders, world.boxes, world.spheres)
    tables = ("cylinders", "boxes", "spheres")
    rows = [(key, row) for key in tables for row in getattr(world, key)]
    for (key, row), low, high in zip(rows, lower, upper, strict=True):
        near = order[np.searchsorted(x, low[0]) : np.searchsorted(x, high[0], side="right")]
        near = near[((points[near, 1:] >= low[1:]) & (points[near, 1:] <= high[1:])).all(axis=1)]
        if len(near):
            single = World("", world.start, world.goal, **{key: row[None]})
            buried[near] |= single.distance(points[near]) < -_BURIED_DEPTH
    return buried
