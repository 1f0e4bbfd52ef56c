"""What stands still: obstacles, ground, the recorded path."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from aero_viz.dashboard import palette
from aero_viz.dashboard.layers.base import Change, Layer, Lines, apply, polylines
from aero_viz.scenes import world_meshes
from aero_viz.session.frame import Frame
from aero_viz.session.source import Source

__all__ = ["GroundLayer", "ObstacleLayer", "RecordedPathLayer"]

_SHAPES = ("cylinders", "boxes", "spheres", "triangles")
_MOST_PATH_SEGMENTS = 2048
_RECORDED = palette.unmapped(palette.RECORDED)


class ObstacleLayer(Layer):
    """Obstacles of a synthetic world, which the planner does not know."""

    name, title = "obstacles", "Obstacles (ground truth)"

    def create(self, scene: viser.SceneApi) -> None:
        empty, face = np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.uint32)
        self._nodes = {
            shape: scene.add_mesh_simple(
                f"/obstacles/{shape}",
                empty,
                face,
                color=palette.OBSTACLE,
                material="toon5",
                side="double" if shape == "triangles" else "front",  # which way they face is anyone's guess
                visible=False,
            )
            for shape in _SHAPES
        }

    def enter(self, source: Source) -> list[Change]:
        world = source.scenery.world
        self.available = world is not None
        meshes = world_meshes(world) if world is not None else {}
        changes: list[Change] = []
        for shape, node in self._nodes.items():
            mesh = meshes.get(shape)
            if mesh is not None:
                changes += [(node, "vertices", mesh.vertices), (node, "faces", mesh.faces.astype(np.uint32))]
            changes.append((node, "visible", mesh is not None))
        return changes


class GroundLayer(Layer):
    """A grid of 1 m and 5 m at the height of the ground."""

    name, title = "ground", "Ground grid"

    def create(self, scene: viser.SceneApi) -> None:
        self._height: float | None = None
        self._grid = scene.add_frame("/ground/grid", show_axes=False)
        fine = _grid(1.0, 25.0)
        coarse = _grid(5.0, 50.0)
        apply(Lines(scene, "/ground/grid/fine", thickness=0.7).show(fine, palette.unmapped(palette.GRID_CELL)))
        apply(Lines(scene, "/ground/grid/coarse", thickness=1.0).show(coarse, palette.unmapped(palette.GRID_SECTION)))

    def enter(self, source: Source) -> list[Change]:
        self._height = source.scenery.ground_height
        return []

    def update(self, frame: Frame) -> list[Change]:
        if self._height is None:
            # Nobody says where the ground is: below nearly all points of the first cloud.
            heights = frame.observation.points[::8, 2]
            heights = heights[np.isfinite(heights)]
            if not len(heights):
                return []
            self._height = float(np.percentile(heights, 1.0)) - 0.05
        # The grid goes with the drone in whole sections, so that its lines seem to stand.
        x, y = np.round(np.asarray(frame.observation.state.position)[:2] / 5.0) * 5.0
        return [(self._grid, "position", (float(x), float(y), self._height))]


def _grid(cell: float, reach: float) -> NDArray[np.float32]:
    """Return the lines of a square grid in the xy plane [m], shape [n, 2, 3], in pieces that fade with distance."""
    at = np.arange(-reach, reach + 1e-6, cell)
    piece = np.linspace(-reach, reach, 9)
    starts, across = np.meshgrid(piece[:-1], at)
    along = np.zeros((starts.size, 2, 3), dtype=np.float32)
    along[:, 0, 0], along[:, 1, 0] = starts.ravel(), starts.ravel() + (piece[1] - piece[0])
    along[:, :, 1] = across.ravel()[:, None]
    return np.concatenate((along, along[:, :, (1, 0, 2)]))


class RecordedPathLayer(Layer):
    """The recorded positions."""

    name, title = "recorded_path", "Recorded path"

    def create(self, scene: viser.SceneApi) -> None:
        self._lines = Lines(scene, "/recorded_path/line", thickness=2.5)

    def enter(self, source: Source) -> list[Change]:
        path = source.scenery.recorded_path
        self.available = path is not None and len(path) > 1
        if path is None or len(path) < 2:
            return self._lines.show(np.zeros((0, 2, 3)), _RECORDED)
        step = -(-len(path) // _MOST_PATH_SEGMENTS)
        vertices = np.concatenate((path[::step], path[-1:])).astype(np.float32)
        return self._lines.show(polylines(vertices), _RECORDED)
