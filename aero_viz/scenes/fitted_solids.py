"""Solids that fit a cluster of points: a cylinder, an upright box, flat sheets, or a mesh.

Points are float64 [n, 3] [m], z up. What fits worse than a tolerance is not returned.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial import KDTree

from aero_viz.open3d_clouds import import_open3d, point_cloud
from aero_viz.scenes.primitives import DISTANCES

Array = NDArray[np.float64]
Height: TypeAlias = Callable[[Array], Array]
FITTED_SHARE = 0.95
"""Share of the points that must lie within the tolerance of a surface."""
_SAMPLES = 1500
"""Points of a cluster that a fit uses."""
_RADIUS = (0.01, 1.5)  # [m] of a trunk
_ARC = 12  # of 36 parts of the circle that must hold points: a scan from one side sees up to half of it
_LENGTH_MIN = 0.5  # [m] of a trunk
_HYPOTHESES = 400  # random cylinders
_THICKNESS_MAX = 1.0  # [m] of a box: points on all sides of a wider one may be the walls of a room
_FILL_MIN = 0.9  # share of a wall that must hold points: a lower one has windows
_UPRIGHT, _AGREEMENT = 0.2, 0.9  # largest vertical part of the normals of a wall, and least cosine between two of them
_PART_MIN, _MESH_MIN, _CLUSTER_MIN = 50, 20, 8  # points


class Fit(NamedTuple):
    """A row of a table of a `World` and the distance within which 95 % of the points lie [m]."""

    table: str
    row: Array
    residual: float

    def distances(self, points: Array) -> Array:
        """Return the distance of each point [n, 3] to the surface [m], [n]."""
        return np.abs(DISTANCES[self.table](points[:, None, :], self.row[None])[:, 0])


def fit_primitive(points: Array, tolerance: float, spacing: float, height: Height) -> Fit | None:
    """Return the cylinder or box on whose surface the points lie, the better one; None if neither does.

    Args:
        points: a cluster [n, 3] [m].
        tolerance: [m].
        spacing: distance between neighbouring points [m].
        height: returns the heights of points above the ground [m].
    """
    longest = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][0]
    fits = (_cylinder(points, tolerance, longest), _box(points, tolerance, spacing, height))
    return min((fit for fit in fits if fit is not None), key=lambda fit: fit.residual, default=None)


def _cylinder(points: Array, tolerance: float, axis: Array) -> Fit | None:
    """Return the cylinder of least squares near an axis [3], robust against points on its ends."""
    points = points[:: max(1, len(points) // _SAMPLES)]
    centre = points.mean(axis=0)
    frame = np.linalg.svd(axis[None])[2][[1, 2, 0]]  # the last row is the axis
    local = (points - centre) @ frame.T

    def radial(values: Array) -> Array:
        lean = values[2:4]
        across = local[:, :2] - values[:2] - local[:, 2:] * lean
        return np.sqrt(np.sum(across**2, axis=1) - (across @ lean) ** 2 / (1.0 + lean @ lean))

    reach = 2.0 * _RADIUS[1]
    low, high = [-reach, -reach, -1.0, -1.0, _RADIUS[0]], [reach, reach, 1.0, 1.0, _RADIUS[1]]
    first = np.array([0.0, 0.0, 0.0, 0.0, 0.0])
    first[4] = np.clip(np.median(radial(first)), 1.1 * _RADIUS[0], 0.9 * _RADIUS[1])
    found = least_squares(lambda x: radial(x) - x[4], first, bounds=(low, high), loss="soft_l1", max_nfev=50,
                          f_scale=0.3 * tolerance).x  # fmt: skip
    axis = np.array([found[2], found[3], 1.0]) @ frame
    axis *= (1.0 if axis[2] >= 0.0 else -1.0) / np.linalg.norm(axis)
    origin, radius = centre + found[:2] @ frame[:2], found[4]
    relative = points - origin
    bottom, top = np.quantile(relative @ axis, [0.005, 0.995])
    if top - bottom < max(_LENGTH_MIN, 2.0 * radius) or radius > 0.99 * _RADIUS[1]:
        return None
    around = relative @ np.linalg.svd(axis[None])[2][1:].T
    arc = len(np.unique(np.floor(np.arctan2(around[:, 1], around[:, 0]) * 18.0 / np.pi)))
    if arc < _ARC and radius > tolerance:
        return None
    return _checked("cylinders", np.array([*(origin + bottom * axis), *axis, radius, top - bottom]), points, tolerance)


def split_trunks(points: Array, tolerance: float, spacing: float) -> tuple[list[Fit], Array]:
    """Return the cylinders in a cluster, and the points that are on none.

    Cylinders are found by RANSAC from the normals of two points each (Schnabel, Wahl and Klein 2007).
    """
    normals, random = _normals(points, spacing), np.random.default_rng(0)
    trunks: list[Fit] = []
    while len(points) >= _PART_MIN:
        axis, part = _largest_cylinder(points, normals, tolerance, spacing, random)
        trunk = _cylinder(points[part], tolerance, axis) if len(part) >= _PART_MIN else None
        if trunk is None:
            break
        trunks.append(trunk)
        left = trunk.distances(points) > tolerance
        points, normals = points[left], normals[left]
    return trunks, points


def _largest_cylinder(
    points: Array, normals: Array, tolerance: float, spacing: float, random: np.random.Generator
) -> tuple[Array, NDArray[np.int64]]:
    """Return the axis [3] of the cylinder of the most points among random ones, and these points by index."""
    count = min(_HYPOTHESES, len(points))
    one = random.choice(len(points), count, replace=False)
    near = np.asarray(KDTree(points).query(points[one], k=min(100, len(points)))[1])
    two = near[np.arange(count), random.integers(near.shape[1], size=count)]
    axes = np.cross(normals[one], normals[two])
    sine = np.maximum(np.linalg.norm(axes, axis=1, keepdims=True), 1e-9)
    axes /= sine
    # The lines through both points along their normals meet on the axis of the cylinder.
    between = points[two] - points[one]
    to_one, to_two = (np.sum(np.cross(between, normals[other]) * axes, axis=1) / sine[:, 0] for other in (two, one))
    radius = np.abs(to_one)
    sound = (np.abs(radius - np.abs(to_two)) < tolerance) & (radius < _RADIUS[1]) & (sine[:, 0] > 0.3)
    axes, radius, centres = axes[sound], radius[sound], (points[one] + to_one[:, None] * normals[one])[sound]
    some = random.choice(len(points), min(_HYPOTHESES, len(points)), replace=False)
    best, most = None, 0
    for axis, r, centre in zip(axes, radius, centres, strict=True):
        votes = int(_on_cylinder(points[some], normals[some], axis, r, centre, tolerance).sum())
        best, most = ((axis, r, centre), votes) if votes > most else (best, most)
    if best is None:
        return np.zeros(3), np.zeros(0, np.int64)
    part = np.flatnonzero(_on_cylinder(points, normals, *best, tolerance))
    along = points[part] @ best[0]
    order = np.argsort(along)
    pieces = np.split(part[order], np.flatnonzero(np.diff(along[order]) > 6.0 * spacing) + 1)
    return best[0], max(pieces, key=len)


def _on_cylinder(points, normals, axis: Array, radius: float, centre: Array, tolerance: float) -> NDArray[np.bool_]:
    relative = points - centre
    across = relative - (relative @ axis)[:, None] * axis
    distance = np.linalg.norm(across, axis=1)
    agrees = np.abs(np.sum(across * normals, axis=1)) > _AGREEMENT * distance
    return (np.abs(distance - radius) <= tolerance) & agrees


def _box(points: Array, tolerance: float, spacing: float, height: Height) -> Fit | None:
    """Return the upright box of the best yaw: that whose sides are closest to the points (Zhang et al. 2017).

    What is missing of a wall because the ground rises there is no window.
    """

    def sides(angle: float) -> tuple[Array, Array, Array]:
        local = points[:, :2] @ _turn(angle).T
        low, high = np.quantile(local, [0.01, 0.99], axis=0)
        return local, low, high

    def closeness(angle: float) -> float:
        local, low, high = sides(angle)
        return float(np.minimum(np.abs(local - low), np.abs(high - local)).min(axis=1).clip(max=tolerance).mean())

    angle = min(np.radians(np.arange(0.0, 90.0, 3.0)), key=closeness)
    angle = min(angle + np.radians(np.arange(-3.0, 3.1, 0.2)), key=closeness)
    local, low, high = sides(angle)
    for axis in range(2):  # a face is where its points are in the mean, not where its noise ends
        for side in (low, high):
            near = local[np.abs(local[:, axis] - side[axis]) < tolerance, axis]
            if len(near) > 0.1 * len(local) and high[axis] - low[axis] > 2.0 * tolerance:
                side[axis] = np.median(near)
    size = np.maximum(high - low, 0.5 * tolerance)
    bottom, top = np.quantile(points[:, 2], [0.005, 0.995])
    if size.min() > _THICKNESS_MAX or top - bottom < tolerance:
        return None
    long = int(np.argmax(size))
    wall = np.stack([local[:, long] - low[long], points[:, 2] - bottom], axis=1)
    cells = np.maximum(np.ceil([size[long] / (2.0 * spacing), (top - bottom) / (2.0 * spacing)]).astype(int), 1)
    held = np.zeros(cells, dtype=bool)
    held[tuple(np.clip((wall / (2.0 * spacing)).astype(int), 0, cells - 1).T)] = True
    empty = (np.argwhere(~held) + 0.5) * 2.0 * spacing
    places = np.tile(0.5 * (low + high), (len(empty), 1))
    places[:, long] = low[long] + empty[:, 0]
    above = height(np.column_stack([places @ _turn(angle), bottom + empty[:, 1]])) > 2.0 * spacing
    if above.sum() > (1.0 - _FILL_MIN) * cells.prod():
        return None
    centre = 0.5 * (low + high) @ _turn(angle)
    row = np.array([*centre, 0.5 * (bottom + top), *size, top - bottom, angle])
    return _checked("boxes", row, points, tolerance)


def _turn(angle: float) -> Array:
    """Return the rotation [2, 2] from the world to axes that are turned by an angle [rad]."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, s], [-s, c]])


def _checked(table: str, row: Array, points: Array, tolerance: float) -> Fit | None:
    residual = float(np.quantile(Fit(table, row, 0.0).distances(points), FITTED_SHARE))
    return Fit(table, row, residual) if residual <= tolerance else None


def clusters(points: Array, spacing: float) -> list[NDArray[np.int64]]:
    """Return the clusters of the points by index (DBSCAN); a point with few neighbours is in none."""
    if not len(points):
        return []
    labels = np.asarray(point_cloud(points).cluster_dbscan(3.0 * spacing, _CLUSTER_MIN))
    return [np.flatnonzero(labels == label) for label in range(labels.max() + 1)]


def _normals(points: Array, spacing: float) -> Array:
    """Return the unit normals of the points [n, 3], without a sign."""
    cloud = point_cloud(points)
    cloud.estimate_normals(import_open3d().geometry.KDTreeSearchParamHybrid(radius=2.0 * spacing, max_nn=30))
    return np.asarray(cloud.normals)


def split_walls(points: Array, tolerance: float, spacing: float, height: Height) -> tuple[list[Fit], Array]:
    """Return the boxes of the upright planes of a cluster, and the points that are in none.

    Planes are found by RANSAC. A part of one that no box fits, such as a wall with windows, is left.
    """
    normals = _normals(points, spacing)
    untried, taken = np.abs(normals[:, 2]) < _UPRIGHT, np.zeros(len(points), dtype=bool)
    walls: list[Fit] = []
    while untried.sum() > _PART_MIN:
        (a, b, c, d), _ = point_cloud(points[untried]).segment_plane(tolerance, 3, 500)
        on_plane = np.abs(points @ [a, b, c] + d) <= tolerance
        plane = np.flatnonzero(on_plane & untried & (np.abs(normals @ [a, b, c]) > _AGREEMENT))
        if len(plane) < _PART_MIN:
            break
        untried[plane] = False
        for part in clusters(points[plane], spacing):
            wall = _box(points[plane[part]], tolerance, spacing, height) if len(part) >= _PART_MIN else None
            if wall is not None:
                walls.append(wall)
                taken[plane[part]] = True
    rest = points[~taken]
    for wall in walls:
        rest = rest[wall.distances(rest) > tolerance]
    return walls, rest


def mesh_triangles(points: Array, tolerance: float, spacing: float) -> Array:
    """Return triangles [m, 9] on the points by ball pivoting (Bernardini et al. 1999), then simplified.

    Balls of a few times the spacing of the points roll over them; a triangle is where one rests on three of them.
    """
    open3d = import_open3d()
    if len(points) < _MESH_MIN:
        return np.zeros((0, 9))
    cloud = point_cloud(points)
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(_MESH_MIN))
    try:
        cloud.orient_normals_consistent_tangent_plane(12)
    except RuntimeError:  # all points lie in a plane: any orientation is consistent
        cloud.orient_normals_to_align_with_direction()
    radii = open3d.utility.DoubleVector(spacing * np.array([1.0, 1.5, 2.5]))
    mesh = open3d.geometry.TriangleMesh.create_from_point_cloud_ball_pivoting(cloud, radii)
    mesh = mesh.simplify_quadric_decimation(len(mesh.triangles) // 6, maximum_error=(0.3 * tolerance) ** 2)
    corners = np.asarray(mesh.vertices)[np.asarray(mesh.triangles)].reshape(-1, 9)
    a, b, c = np.split(corners, 3, axis=1)
    return corners[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-9]
