"""The spherical partition: measured, continued and unseen fine cells, and coarse cells with their safe directions."""

from __future__ import annotations

from typing import Any

import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray

from aero_planner import Plan
from aero_planner.quaternions import rotation_matrix
from aero_viz.dashboard import palette
from aero_viz.dashboard.layers.base import Change, ColorKey, ColorScale, Layer, Lines, full_plan
from aero_viz.planners.plan import cell_angles, directions_at
from aero_viz.session.frame import Frame

_SQUARE = np.array([[0.0, -0.5, -0.5], [0.0, 0.5, -0.5], [0.0, 0.5, 0.5], [0.0, -0.5, 0.5]], dtype=np.float32)
_BORDER = palette.unmapped(palette.GRID_SECTION)
_ANCHOR = palette.unmapped(palette.ANCHOR)
_UNSEEN = palette.unmapped(palette.UNSEEN)
_CONTINUED = palette.unmapped(palette.CONTINUED)
_FREE = palette.unmapped(palette.NEAR_TO_FAR)
_RANGE = palette.lit(palette.NEAR_TO_FAR)
_CONTINUED_LIT = palette.lit(palette.CONTINUED)
_SPHERE = 2.0
"""Radius at which coarse and unseen cells are drawn [m]."""


class CellPatches:
    """A patch for every fine cell, which faces the drone and has the width of the cell.

    Args:
        scene: scene of the page.
        name: path of the node; its parent is the frame of the body.
        opacity: opacity of the patches.
    """

    def __init__(self, scene: viser.SceneApi, name: str, *, opacity: float) -> None:
        self._pose = scene.add_frame(f"{name}/body", show_axes=False)
        self._shape: tuple[int, ...] = ()
        self.node = scene.add_batched_meshes_simple(
            f"{name}/body/patches", _SQUARE, np.array([[0, 1, 2], [0, 2, 3]], np.uint32),
            np.array([[1.0, 0.0, 0.0, 0.0]]), np.zeros((1, 3)), batched_scales=np.zeros((1, 3), np.float32),
            batched_colors=np.zeros((1, 3), np.uint8), side="double", lod="off", opacity=opacity, flat_shading=True,
            cast_shadow=False, receive_shadow=False,
        )  # fmt: skip

    def show(self, frame: Frame, ranges: NDArray[np.floating[Any]], shown: NDArray[np.bool_]) -> list[Change]:
        """Return the changes that show some cells at their ranges [m]; both are of shape [rows * columns, 1]."""
        shape = full_plan(frame).fine_range.shape
        changes = _pose(self._pose, frame)
        if shape != self._shape:
            self._shape = shape
            azimuth, elevation = cell_angles(shape)
            self._direction = directions_at(azimuth, elevation)
            step = np.radians(180.0 / shape[0])
            self._size = 1.84 * np.tan(0.5 * step) * np.stack(
                (np.ones_like(azimuth), np.cos(elevation), np.ones_like(azimuth)), axis=1
            )  # fmt: skip
            changes.append((self.node, "batched_wxyzs", _facing(azimuth, elevation)))
        return [
            *changes,
            (self.node, "batched_positions", (self._direction * ranges).astype(np.float32)),
            (self.node, "batched_scales", np.where(shown, self._size * ranges, 0.0).astype(np.float32)),
        ]


class FineCellLayer(Layer):
    """A patch at the range of every occupied fine cell. Measured ones are coloured by range; yellow is near.

    Continued ones have a colour of their own: a surface goes on there past the field of view, as the plan assumes.
    """

    name, title, on_by_default = "fine_cells", "Occupied cells", False
    needs = "cells"
    keys = (ColorKey("occupied, continued: not measured", palette.CONTINUED),)

    def create(self, scene: viser.SceneApi) -> None:
        self._patches = CellPatches(scene, "/fine_cells", opacity=0.4)

    def update(self, frame: Frame) -> list[Change]:
        ranges, reach = full_plan(frame).fine_range.reshape(-1, 1), frame.config.farthest_range
        colors = palette.colorize(ranges[:, 0], 0.0, reach, _RANGE)
        colors[is_continued(frame)[:, 0]] = _CONTINUED_LIT
        return [*self._patches.show(frame, ranges, is_occupied(frame)), (self._patches.node, "batched_colors", colors)]

    def legend(self, frame: Frame) -> list[ColorKey | ColorScale]:
        is_known = full_plan(frame).continued_cells is not None
        label = "occupied, measured: range" if is_known else "occupied cells, with continued surfaces: range"
        scale = ColorScale(label, "0 m", f"{frame.config.farthest_range:g} m", palette.NEAR_TO_FAR)
        return [scale, *self.keys] if is_continued(frame).any() else [scale]


class UnseenCellLayer(Layer):
    """Continued fine cells, and empty ones outside the field of view, on a sphere of 2 m.

    The sensor does not see the empty ones now; older sweeps show nothing there. The planner assumes that they are free,
    and continued ones up to the continued surface. Ground of known height is an obstacle in all of them.
    """

    name, title, on_by_default = "unseen_cells", "Unseen cells", False
    needs = "cells"

    def create(self, scene: viser.SceneApi) -> None:
        self._patches = CellPatches(scene, "/unseen_cells", opacity=0.25)

    def update(self, frame: Frame) -> list[Change]:
        unseen = is_unseen(frame)
        changes = self._patches.show(frame, np.full(unseen.shape, _SPHERE), unseen)
        return [*changes, (self._patches.node, "batched_colors", np.where(is_continued(frame), _CONTINUED, _UNSEEN))]

    def legend(self, frame: Frame) -> list[ColorKey]:
        unseen, continued = is_unseen(frame), is_continued(frame)
        above = " above the ground" if is_ground_known(frame) else ""
        empty = ColorKey(f"unseen, empty: assumed free{above}", palette.UNSEEN)
        near = ColorKey("unseen, continued: assumed free up to the surface", palette.CONTINUED)
        return [empty] * bool((unseen & ~continued).any()) + [near] * bool((unseen & continued).any())


class CoarseCellLayer(Layer):
    """Coarse cells on a sphere of 2 m, and a line along each safe direction, longer where more range is free.

    The colour is the mean range of the cell. The largest range would be that of any gap, and the same for nearly all
    cells. Cells that hold an anchor direction have lines in the colour of anchors.
    """

    name, title, on_by_default = "coarse_cells", "Coarse cells and safe directions", False
    needs = "cells"

    def create(self, scene: viser.SceneApi) -> None:
        self._pose = scene.add_frame("/coarse_cells/body", show_axes=False)
        self._shape: tuple[int, ...] = ()
        self._borders = Lines(scene, "/coarse_cells/body/borders", thickness=1.0)
        self._directions = Lines(scene, "/coarse_cells/body/directions", thickness=2.5, capacity=256)

    def update(self, frame: Frame) -> list[Change]:
        ranges, directions = full_plan(frame).safe_range, full_plan(frame).safe_direction
        changes = _pose(self._pose, frame)
        if ranges.shape != self._shape:
            self._shape = ranges.shape
            changes += self._borders.show(_SPHERE * _borders(ranges.shape), _BORDER)
        reach = frame.config.farthest_range
        start = _SPHERE * directions.reshape(-1, 3)
        share = ranges.reshape(-1, 1) / reach
        colors = palette.colorize(mean_ranges(full_plan(frame)).reshape(-1), 0.0, reach, _FREE)
        colors[anchor_cells(frame)] = _ANCHOR
        colors = colors[:, None, :]
        return [*changes, *self._directions.show(np.stack((start, start * (1.0 + 0.5 * share)), axis=1), colors)]

    def legend(self, frame: Frame) -> list[ColorKey | ColorScale]:
        reach = f"{frame.config.farthest_range:g} m"
        return [
            ColorScale("safe directions: mean range of the cell", "0 m", reach, palette.NEAR_TO_FAR),
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
    rows, columns = full_plan(frame).safe_range.shape
    state = frame.observation.state
    offset = full_plan(frame).initial_endpoints[: frame.config.anchor_count] - np.asarray(state.position)
    return np.unique(cells_of(np.asarray(offset, dtype=np.float64), state.quaternion, (rows, columns)))


def cells_of(directions: NDArray[np.float64], quaternion: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Return the cells, counted row by row, that hold directions, shape [n, 3], world frame.

    Args:
        directions: the directions, of any length.
        quaternion: attitude of the drone, body to world, w x y z.
        shape: rows and columns of the cells.
    """
    rows, columns = shape
    x, y, z = (directions @ rotation_matrix(quaternion)).T  # R^T d, as rows
    row = (np.arctan2(z, np.hypot(x, y)) / np.pi + 0.5) * rows
    column = (np.arctan2(y, x) / (2.0 * np.pi) + 0.5) * columns
    return np.clip(row.astype(int), 0, rows - 1) * columns + column.astype(int) % columns


def is_occupied(frame: Frame) -> NDArray[np.bool_]:
    """Return True for fine cells with a point or a continued surface, row by row, shape [rows * columns, 1]."""
    return full_plan(frame).fine_range.reshape(-1, 1) < frame.config.farthest_range - 1e-4


def is_continued(frame: Frame) -> NDArray[np.bool_]:
    """Return True for fine cells into which a surface is continued, row by row, shape [rows * columns, 1].

    False for all of them where the plan does not say so.
    """
    continued = full_plan(frame).continued_cells
    return np.zeros((full_plan(frame).fine_range.size, 1), np.bool_) if continued is None else continued.reshape(-1, 1)


def is_unseen(frame: Frame) -> NDArray[np.bool_]:
    """Return True for fine cells that are continued, or empty and out of view, row by row, [rows * columns, 1]."""
    return is_continued(frame) | (~is_in_view(frame) & ~is_occupied(frame))


def is_ground_known(frame: Frame) -> bool:
    """Return True if the planner takes the ground for an obstacle."""
    return frame.config.costs.use_ground and frame.observation.ground_height is not None


def is_in_view(frame: Frame) -> NDArray[np.bool_]:
    """Return True for fine cells whose centre the sensor can see now, row by row, shape [rows * columns, 1]."""
    azimuth, elevation = (np.degrees(angle) for angle in cell_angles(full_plan(frame).fine_range.shape))
    seen = np.zeros(azimuth.shape, np.bool_)
    for lowest, highest, width, middle in frame.config.unseen_space.views:
        off = np.abs((azimuth - middle + 180.0) % 360.0 - 180.0)
        seen |= (elevation >= lowest) & (elevation <= highest) & (off <= 0.5 * width)
    return seen[:, None]


def _pose(node: viser.FrameHandle, frame: Frame) -> list[Change]:
    state = frame.observation.state
    return [(node, "position", np.asarray(state.position)), (node, "wxyz", np.asarray(state.quaternion))]


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
    around = directions_at(*np.broadcast_arrays(fine[None], parallels[:, None]))
    upward = directions_at(*np.broadcast_arrays(meridians[:, None], span[None]))
    return np.concatenate([np.stack((arc[:, :-1], arc[:, 1:]), axis=2).reshape(-1, 2, 3) for arc in (around, upward)])
