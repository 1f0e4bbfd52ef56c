"""The spherical partition: occupied fine cells, and coarse cells with their safe directions."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from aero_planner import Plan
from aero_planner.quaternions import rotation_matrix
from aero_viz.dashboard import palette
from aero_viz.dashboard.layers.base import Change, ColorKey, ColorScale, Layer, Lines
from aero_viz.session.frame import Frame

_SQUARE = np.array([[0.0, -0.5, -0.5], [0.0, 0.5, -0.5], [0.0, 0.5, 0.5], [0.0, -0.5, 0.5]], dtype=np.float32)
_BORDER = palette.unmapped(palette.GRID_SECTION)
_ANCHOR = palette.unmapped(palette.ANCHOR)
_FREE = palette.unmapped(palette.VIRIDIS)
_RANGE = palette.lit(palette.NEAR_TO_FAR)
_SPHERE = 2.0
"""Radius at which the coarse cells are drawn [m]."""


class FineCellLayer(Layer):
    """A patch at the range of every occupied fine cell, coloured by range. Red is near.

    Cells outside the field of view into which a surface is continued count as occupied, as they do in the plan.
    """

    name, title, on_by_default = "fine_cells", "Occupied cells", False

    def create(self, scene: viser.SceneApi) -> None:
        self._pose = scene.add_frame("/fine_cells/body", show_axes=False)
        self._shape: tuple[int, ...] = ()
        self._node = scene.add_batched_meshes_simple(
            "/fine_cells/body/patches", _SQUARE, np.array([[0, 1, 2], [0, 2, 3]], np.uint32),
            np.array([[1.0, 0.0, 0.0, 0.0]]), np.zeros((1, 3)), batched_scales=np.zeros((1, 3), np.float32),
            batched_colors=np.zeros((1, 3), np.uint8), side="double", lod="off", opacity=0.85, flat_shading=True,
            cast_shadow=False, receive_shadow=False,
        )  # fmt: skip

    def update(self, frame: Frame) -> list[Change]:
        ranges = frame.plan.fine_range
        changes = _pose(self._pose, frame)
        if ranges.shape != self._shape:
            self._shape = ranges.shape
            azimuth, elevation = _centers(ranges.shape)
            self._direction = _direction(azimuth, elevation)
            step = np.radians(180.0 / ranges.shape[0])
            self._size = 1.84 * np.tan(0.5 * step) * np.stack(
                (np.ones_like(azimuth), np.cos(elevation), np.ones_like(azimuth)), axis=1
            )  # fmt: skip
            changes.append((self._node, "batched_wxyzs", _facing(azimuth, elevation)))
        reach = frame.config.farthest_range
        flat = ranges.reshape(-1, 1)
        occupied = flat < reach - 1e-4
        return [
            *changes,
            (self._node, "batched_positions", (self._direction * flat).astype(np.float32)),
            (self._node, "batched_scales", np.where(occupied, self._size * flat, 0.0).astype(np.float32)),
            (self._node, "batched_colors", palette.colorize(flat[:, 0], 0.0, reach, _RANGE)),
        ]

    def legend(self, frame: Frame) -> list[ColorScale]:
        reach = f"{frame.config.farthest_range:g} m"
        return [ColorScale("occupied cells, with continued surfaces: range", "0 m", reach, palette.NEAR_TO_FAR)]


class CoarseCellLayer(Layer):
    """Coarse cells on a sphere of 2 m, and a line along each safe direction, longer where more range is free.

    The colour is the mean range of the cell: the largest one is that of any gap, and equal for nearly all cells. Cells
    that hold an anchor direction have lines in the colour of anchors.
    """

    name, title, on_by_default = "coarse_cells", "Coarse cells and safe directions", False

    def create(self, scene: viser.SceneApi) -> None:
        self._pose = scene.add_frame("/coarse_cells/body", show_axes=False)
        self._shape: tuple[int, ...] = ()
        self._borders = Lines(scene, "/coarse_cells/body/borders", thickness=1.0)
        self._directions = Lines(scene, "/coarse_cells/body/directions", thickness=2.5, capacity=256)

    def update(self, frame: Frame) -> list[Change]:
        ranges, directions = frame.plan.safe_range, frame.plan.safe_direction
        changes = _pose(self._pose, frame)
        if ranges.shape != self._shape:
            self._shape = ranges.shape
            changes += self._borders.show(_SPHERE * _borders(ranges.shape), _BORDER)
        reach = frame.config.farthest_range
        start = _SPHERE * directions.reshape(-1, 3)
        share = ranges.reshape(-1, 1) / reach
        colors = palette.colorize(mean_ranges(frame.plan).reshape(-1), 0.0, reach, _FREE)
        colors[anchor_cells(frame)] = _ANCHOR
        colors = colors[:, None, :]
        return [*changes, *self._directions.show(np.stack((start, start * (1.0 + 0.5 * share)), axis=1), colors)]

    def legend(self, frame: Frame) -> list[ColorKey | ColorScale]:
        reach = f"{frame.config.farthest_range:g} m"
        return [
            ColorScale("safe directions: mean range of the cell", "0 m", reach, palette.VIRIDIS),
            ColorKey("cells of anchors", palette.ANCHOR),
            ColorKey("coarse cells", palette.GRID_SECTION),
        ]


def mean_ranges(plan: Plan) -> NDArray[np.float64]:
    """Return the mean range of the fine cells of each coarse cell [m], shape [rows, columns]."""
    rows, columns = plan.safe_range.shape
    fine = np.asarray(plan.fine_range, dtype=np.float64)
    return fine.reshape(rows, fine.shape[0] // rows, columns, fine.shape[1] // columns).mean(axis=(1, 3))


def anchor_cells(frame: Frame) -> NDArray[np.int64]:
    """Return the coarse cells, counted row by row, that hold the anchor directions before the refinement."""
    rows, columns = frame.plan.safe_range.shape
    state = frame.observation.state
    offset = frame.plan.initial_endpoints[: frame.config.anchor_count] - np.asarray(state.position)
    x, y, z = (np.asarray(offset, dtype=np.float64) @ rotation_matrix(state.quaternion)).T  # R^T d, as rows
    row = (np.arctan2(z, np.hypot(x, y)) / np.pi + 0.5) * rows
    column = (np.arctan2(y, x) / (2.0 * np.pi) + 0.5) * columns
    row, column = np.clip(row.astype(int), 0, rows - 1), column.astype(int) % columns
    return np.unique(row * columns + column)


def _pose(node: viser.FrameHandle, frame: Frame) -> list[Change]:
    state = frame.observation.state
    return [(node, "position", np.asarray(state.position)), (node, "wxyz", np.asarray(state.quaternion))]


def _centers(shape: tuple[int, ...]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the azimuth and elevation of every cell [rad], row by row, each of shape [rows * columns]."""
    rows, columns = shape
    elevation = np.radians(-90.0 + 180.0 * (np.arange(rows) + 0.5) / rows)
    azimuth = np.radians(-180.0 + 360.0 * (np.arange(columns) + 0.5) / columns)
    return np.tile(azimuth, rows), np.repeat(elevation, columns)


def _direction(azimuth: NDArray[np.float64], elevation: NDArray[np.float64]) -> NDArray[np.float64]:
    flat = np.cos(elevation)
    return np.stack((flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)), axis=-1)


def _facing(azimuth: NDArray[np.float64], elevation: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return quaternions (w, x, y, z) that turn +x to each direction: pitch by -elevation, then yaw by azimuth."""
    cy, sy, cp, sp = np.cos(azimuth / 2), np.sin(azimuth / 2), np.cos(-elevation / 2), np.sin(-elevation / 2)
    return np.stack((cy * cp, -sy * sp, cy * sp, sy * cp), axis=-1).astype(np.float32)


def _borders(shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return the borders of the cells on the unit sphere as segments, shape [n, 2, 3], in steps of 6 deg."""
    rows, columns = shape
    fine = np.radians(np.arange(-180.0, 180.1, 6.0))
    parallels = np.radians(np.linspace(-90.0, 90.0, rows + 1)[1:-1])
    meridians = np.radians(np.linspace(-180.0, 180.0, columns, endpoint=False))
    span = np.radians(np.linspace(-90.0 + 180.0 / rows, 90.0 - 180.0 / rows, 25))
    around = _direction(*np.broadcast_arrays(fine[None], parallels[:, None]))
    upward = _direction(*np.broadcast_arrays(meridians[:, None], span[None]))
    return np.concatenate([np.stack((arc[:, :-1], arc[:, 1:]), axis=2).reshape(-1, 2, 3) for arc in (around, upward)])
