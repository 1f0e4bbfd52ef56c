"""Obstacles, ground and recorded path: what is fixed for a source."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from aero_viz.dashboard import palette
from aero_viz.dashboard.layers.base import Change, ColorKey, Layer, Lines, apply, polylines
from aero_viz.scenes import world_meshes
from aero_viz.session.frame import Frame
from aero_viz.session.source import SourceInfo

__all__ = ["GroundLayer", "ObstacleLayer", "RecordedPathLayer"]

_SHAPES = ("cylinders", "boxes", "spheres", "triangles")
_MOST_PATH_SEGMENTS = 2048
_RECORDED = palette.unmapped(palette.RECORDED)


class ObstacleLayer(Layer):
    """Obstacles of a synthetic world. The planner does not know them."""

    name, title = "obstacles", "Obstacles (ground truth)"
    keys = (ColorKey("obstacles", palette.OBSTACLE),)

    def create(self, scene: viser.SceneApi) -> None:
        degenerate, face = np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.uint32)
        self.nodes = {
            shape: scene.add_mesh_simple(
                f"/obstacles/{shape}",
                degenerate,
                face,
                color=palette.OBSTACLE,
                material="toon5",
                side="double" if shape == "triangles" else "front",  # the triangles of a mesh may face either way
                visible=False,
            )
            for shape in _SHAPES
        }

    def on_new_source(self, source: SourceInfo) -> list[Change]:
        world = source.world
        self.available = world is not None
        meshes = world_meshes(world) if world is not None else {}
        changes: list[Change] = []
        for shape, node in self.nodes.items():
            mesh = meshes.get(shape)
            if mesh is not None:
                changes += [(node, "vertices", mesh.vertices), (node, "faces", mesh.faces.astype(np.uint32))]
            changes.append((node, "visible", mesh is not None))
        return changes


class GroundLayer(Layer):
    """Grid of 1 m and 5 m cells at the height of the ground."""

    name, title = "ground", "Ground grid"
    keys = (ColorKey("ground grid", palette.GRID_SECTION),)

    def create(self, scene: viser.SceneApi) -> None:
        self._estimated_height: float | None = None
        self._grid = scene.add_frame("/ground/grid", show_axes=False)
        fine = _grid(1.0, 25.0)
        coarse = _grid(5.0, 50.0)
        apply(Lines(scene, "/ground/grid/fine", thickness=0.7).show(fine, palette.unmapped(palette.GRID_CELL)))
        apply(Lines(scene, "/ground/grid/coarse", thickness=1.0).show(coarse, palette.unmapped(palette.GRID_SECTION)))

    def on_new_source(self, source: SourceInfo) -> list[Change]:
        self._estimated_height = None
        return []

    def update(self, frame: Frame) -> list[Change]:
        height = frame.observation.ground_height
        if height is None:
            if self._estimated_height is None:
                self._estimated_height = _height_below(frame.observation.points)
            height = self._estimated_height
        if height is None:
            return []
        # The grid follows the drone in steps of whole sections, so that its lines seem fixed.
        x, y = np.round(np.asarray(frame.observation.state.position)[:2] / 5.0) * 5.0
        return [(self._grid, "position", (float(x), float(y), height))]


def _height_below(points: NDArray[np.float32]) -> float | None:
    """Return a height just below nearly all points [m], None for an empty cloud."""
    heights = points[::8, 2]
    heights = heights[np.isfinite(heights)]
    return float(np.percentile(heights, 1.0)) - 0.05 if len(heights) else None


def _grid(cell: float, reach: float) -> NDArray[np.float32]:
    """Return a square grid in the xy plane as segments [m], shape [n, 2, 3]; short ones, so that fog can fade them."""
    knots = np.linspace(-reach, reach, 9)
    x, y = np.meshgrid(knots[:-1], np.arange(-reach, reach + 1e-6, cell))
    segments = np.zeros((x.size, 2, 3), dtype=np.float32)
    segments[:, 0, 0], segments[:, 1, 0] = x.ravel(), x.ravel() + (knots[1] - knots[0])
    segments[:, :, 1] = y.ravel()[:, None]
    return np.concatenate((segments, segments[:, :, (1, 0, 2)]))


class RecordedPathLayer(Layer):
    """Recorded positions of the drone."""

    name, title = "recorded_path", "Recorded path"
    keys = (ColorKey("recorded path", palette.RECORDED),)

    def create(self, scene: viser.SceneApi) -> None:
        self._lines = Lines(scene, "/recorded_path/line", thickness=2.5)

    def on_new_source(self, source: SourceInfo) -> list[Change]:
        path = source.recorded_path
        self.available = path is not None and len(path) > 1
        if path is None or len(path) < 2:
            return self._lines.show(np.zeros((0, 2, 3)), _RECORDED)
        step = -(-len(path) // _MOST_PATH_SEGMENTS)
        vertices = np.concatenate((path[::step], path[-1:])).astype(np.float32)
        return self._lines.show(polylines(vertices), _RECORDED)
