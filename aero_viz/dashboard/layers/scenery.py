"""Obstacles, ground and recorded path: the constants of a source."""

from __future__ import annotations

from typing import Any

import numpy as np
import viser
import viser.transforms
from numpy.typing import NDArray

from aero_viz.dashboard import palette
from aero_viz.dashboard.layers.base import Change, ColorKey, Layer, Lines, apply, headroom, polylines, view_targets
from aero_viz.scenes import Instances, Mesh, SightLines, World, world_instances, world_meshes
from aero_viz.scenes.mesh import SHAPES, joined_mesh
from aero_viz.scenes.obstacles import KINDS, ObstacleId, ObstacleKey, added_rows, find_obstacle
from aero_viz.session.frame import Frame
from aero_viz.session.source import SourceInfo

_FAINT = 0.12
"""Opacity of an obstacle that hides the drone or its plan."""
_NO_FACES = np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.uint32)
_NO_MESH = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
_NO_ROWS = np.zeros(0, np.int64)
_MOST_PATH_SEGMENTS = 2048
_RECORDED = palette.unmapped(palette.RECORDED)


class ObstacleLayer(Layer):
    """Obstacles of a synthetic world. The planner does not know them. Those that hide the drone are faint, unless they
    move or were added during the flight. Whoever looks from above sees them cut above the drone."""

    name, title = "obstacles", "Obstacles (ground truth)"
    keys = (ColorKey("obstacles", palette.OBSTACLE),)

    def create(self, scene: viser.SceneApi) -> None:
        self.selected: ObstacleId | None = None
        """Selected obstacle, which has the colour of a selection and is never faint."""
        self._world: World | None = None
        self._top: float | None = None
        self._sight: SightLines | None = None
        self._instances: dict[str, Instances] = {}
        self._surface = _NO_MESH
        self._drawn_rows: dict[str, NDArray[np.int64]] = {}
        """Row in the world of each instance, by kind."""
        self._solid: dict[str, NDArray[np.int64]] = {}
        """Instances that are never faint, by kind."""
        self._faded: dict[str, NDArray[np.int64]] = {}
        self._marked: dict[str, NDArray[np.int64]] = {}
        style: Any = {"material": "toon5", "visible": False}
        self.solids: dict[str, viser.BatchedMeshHandle] = {
            kind: scene.add_batched_meshes_simple(
                f"/obstacles/{kind}",
                shape.vertices,
                shape.faces.astype(np.uint32),
                np.array([[1.0, 0.0, 0.0, 0.0]]),
                np.zeros((1, 3)),
                batched_scales=np.zeros((1, 3), np.float32),
                batched_colors=palette.as_rgb(palette.linear([palette.OBSTACLE]))[0],
                lod="off",
                cast_shadow=False,
                receive_shadow=False,
                **style,
            )
            for kind, shape in SHAPES.items()
        }
        style["color"] = palette.OBSTACLE
        # The triangles of a mesh may face either way.
        self.triangles = scene.add_mesh_simple("/obstacles/triangles", *_NO_FACES, side="double", **style)
        self.faint = scene.add_mesh_simple("/obstacles/faint", *_NO_FACES, opacity=_FAINT, **style)
        self.marked = scene.add_mesh_simple("/obstacles/marked", *_NO_FACES, **style | {"color": palette.SELECTED})

    def on_new_source(self, source: SourceInfo) -> list[Change]:
        self.available = source.world is not None
        return self._show(source.world, source.world, None)

    def _show(self, world: World | None, moving: World | None, top: float | None) -> list[Change]:
        """Return the changes that show the obstacles of a world.

        Args:
            world: the obstacles, where they are.
            moving: the same with their motion.
            top: height at which they are cut [m].
        """
        self._world, self._top = world, top
        self._faded, self._marked = {}, {}
        self._drawn_rows = {} if world is None else {kind: _drawn_rows(world, kind) for kind in KINDS.values()}
        self._solid = {} if moving is None else {kind: self._never_faint(moving, kind) for kind in KINDS.values()}
        self._sight = None if world is None else SightLines(world)
        self._instances = {} if world is None else world_instances(world)
        self._surface = _NO_MESH if world is None else world_meshes(world).get("triangles", _NO_MESH)
        if top is not None:
            self._instances = {kind: instances.below(top) for kind, instances in self._instances.items()}
            lowest = self._surface.vertices[self._surface.faces, 2].min(axis=1)
            self._surface = Mesh(self._surface.vertices, np.where(lowest[:, None] > top, 0, self._surface.faces))
        changes: list[Change] = [
            (self.faint, "visible", False),
            (self.marked, "visible", False),
            (self.triangles, "visible", bool(self._surface.faces.any())),
            (self.triangles, "vertices", self._surface.vertices),
            (self.triangles, "faces", self._surface.faces.astype(np.uint32)),
        ]
        for kind, node in self.solids.items():
            if (instances := self._instances.get(kind)) is not None:
                wxyzs = viser.transforms.SO3.from_matrix(instances.rotations).wxyz
                changes += [
                    (node, "batched_positions", instances.positions.astype(np.float32)),
                    (node, "batched_wxyzs", wxyzs.astype(np.float32)),
                    (node, "batched_scales", instances.scales),
                ]
            changes.append((node, "visible", instances is not None))
        return changes

    def update(self, frame: Frame) -> list[Change]:
        """Replace the obstacles between a camera and the drone, or its plan, by faint ones, and cut what is above."""
        top = headroom(self.eyes, frame)
        changes: list[Change] = []
        if frame.world is not self._world or top != self._top:
            changes = self._show(frame.world, frame.moving_world, top)
        return [*changes, *self._fade(frame)]

    def _fade(self, frame: Frame) -> list[Change]:
        if self._sight is None:
            return []
        targets, radii = view_targets(frame)
        found = [self._sight.blocked_by(eye, targets, radii) for eye in self.eyes]
        kinds = (*self._instances, "triangles")
        faded = {kind: np.unique(np.concatenate([_NO_ROWS, *(rows[kind] for rows in found)])) for kind in kinds}
        marked = self._selected_rows()
        for solid in (marked, self._solid):
            faded |= {kind: np.setdiff1d(faded[kind], rows) for kind, rows in solid.items() if kind in faded}
        if _equal(faded, self._faded) and _equal(marked, self._marked):
            return []
        self._faded, self._marked = faded, marked
        hidden = {kind: np.append(rows, marked.get(kind, _NO_ROWS)) for kind, rows in faded.items()}
        return [*self._remaining(hidden), *self._drawn(self.faint, faded), *self._drawn(self.marked, marked)]

    def _selected_rows(self) -> dict[str, NDArray[np.int64]]:
        """Return the row of the selected obstacle among the instances of its kind; nothing if it is not there."""
        key = None if self.selected is None or self._world is None else find_obstacle(self._world, self.selected)
        if key is None or self._world is None or key.kind not in self._instances:
            return {}
        return {key.kind: np.flatnonzero(self._drawn_rows[key.kind] == key.row)}

    def _never_faint(self, world: World, kind: str) -> NDArray[np.int64]:
        """Return the instances of a kind that were added or move: they matter most where they hide the plan."""
        rows = added_rows(world, kind)
        if kind == "cylinders":
            rows = np.union1d(rows, np.flatnonzero(world.moves))
        return np.flatnonzero(np.isin(self._drawn_rows[kind], rows))

    @property
    def faint_obstacles(self) -> list[ObstacleKey]:
        """The solids that are faint."""
        faded = {kind: self._drawn_rows[kind][rows] for kind, rows in self._faded.items() if kind in self._drawn_rows}
        return [ObstacleKey(kind, int(row)) for kind, rows in faded.items() for row in rows]

    def _remaining(self, hidden: dict[str, NDArray[np.int64]]) -> list[Change]:
        changes: list[Change] = []
        for kind, instances in self._instances.items():
            scales = instances.scales
            scales[hidden[kind]] = 0.0
            changes.append((self.solids[kind], "batched_scales", scales))
        faces = self._surface.faces.astype(np.uint32)
        faces[hidden["triangles"]] = 0
        return [*changes, (self.triangles, "faces", faces)]

    def _drawn(self, node: viser.MeshHandle, shown: dict[str, NDArray[np.int64]]) -> list[Change]:
        """Return the changes that let a node show these obstacles."""
        parts = [self._instances[kind].merged(rows) for kind, rows in shown.items() if kind != "triangles"]
        rows = self._surface.faces[shown.get("triangles", _NO_ROWS)]
        parts.append(
            Mesh(self._surface.vertices[rows.reshape(-1)], np.arange(rows.size, dtype=np.int32).reshape(-1, 3))
        )
        mesh = joined_mesh(parts)
        if not len(mesh.faces):
            return [(node, "visible", False)]
        return [
            (node, "vertices", mesh.vertices),
            (node, "faces", mesh.faces.astype(np.uint32)),
            (node, "visible", True),
        ]


def _drawn_rows(world: World, kind: str) -> NDArray[np.int64]:
    """Return the rows of a table whose solids are drawn: all but the ground."""
    return np.flatnonzero(~world.ground) if kind == "boxes" else np.arange(len(getattr(world, kind)))


def _equal(rows: dict[str, NDArray[np.int64]], others: dict[str, NDArray[np.int64]]) -> bool:
    return all(np.array_equal(rows.get(k, _NO_ROWS), others.get(k, _NO_ROWS)) for k in {*rows, *others})


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


class RecordedPlanLayer(Layer):
    """Chosen rollout of the plan that was flown, from a flight log."""

    name, title = "recorded_plan", "Recorded plan"
    keys = (ColorKey("recorded plan", palette.RECORDED),)

    def create(self, scene: viser.SceneApi) -> None:
        self.available = False
        self._lines = Lines(scene, "/recorded_plan/line", thickness=5.0)

    def on_new_source(self, source: SourceInfo) -> list[Change]:
        self.available = source.recorded_plan is not None
        return self._lines.show(np.zeros((0, 2, 3)), _RECORDED)

    def update(self, frame: Frame) -> list[Change]:
        recorded = frame.recorded_plan
        path = np.zeros((0, 3), np.float32) if recorded is None else recorded.path
        return self._lines.show(polylines(path) if len(path) else np.zeros((0, 2, 3)), _RECORDED)
