"""Base of all layers, and line segments in a buffer of fixed size."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, cast

import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray

from aero_planner import Plan as EnsemblePlan
from aero_planner.config import DroneConfig
from aero_viz.dashboard import palette
from aero_viz.dashboard.history import FlightHistory
from aero_viz.dashboard.viser_private import is_removed
from aero_viz.planners.plan import lacks
from aero_viz.session.frame import Frame
from aero_viz.session.source import SourceInfo

_DRONE_MARGIN, _PATH_MARGIN = 0.6, 0.15
"""Obstacles nearer than this to the line of sight to the drone, or to its plan, are drawn faint [m]."""
_STEEP = float(np.tan(np.radians(55.0)))
_HEADROOM, _HEADROOM_STEP = 0.4, 0.5
"""Least height above the drone up to which obstacles are drawn for whoever looks from above, and its steps [m]."""
Change = tuple[Any, str, Any]
"""Handle, property, new value. All changes of an update are computed first and then assigned together."""


def apply(changes: Iterable[Change], *, computed_at: float = math.inf) -> None:
    """Assign every change; viser sends only properties that differ. Handles of visitors who have left are skipped.

    Args:
        changes: the changes.
        computed_at: when they were computed [s], `time.time`. An input that got another value since then keeps it:
            somebody has just clicked or typed.
    """
    for handle, name, value in changes:
        if name == "value" and getattr(handle, "update_timestamp", 0.0) > computed_at:
            continue
        try:
            setattr(handle, name, value)
        except RuntimeError:
            if not is_removed(handle):
                raise


@dataclass(frozen=True)
class ColorKey:
    """Legend entry of something drawn in one colour."""

    label: str
    color: palette.Rgb


@dataclass(frozen=True, eq=False)
class ColorScale:
    """Legend entry of something coloured by a quantity."""

    label: str
    low: str
    """Text at the left end."""
    high: str
    """Text at the right end."""
    colormap: palette.Colormap
    """Colours from left to right."""


class Bar(NamedTuple):
    """One column of a bar chart."""

    height: float
    """From 0 to 1."""
    tooltip: str
    color: palette.Rgb
    is_marked: bool
    is_faint: bool = False


class BarChart(NamedTuple):
    """Chart for the status panel."""

    label: str
    summary: str
    """Text at the right end of the heading."""
    bars: Sequence[Bar]


@dataclass
class Option:
    """A choice that a layer offers on the page, as a dropdown."""

    label: str
    choices: Callable[[DroneConfig], Sequence[str]]
    """Returns the choices under a configuration."""
    value: str
    """The current choice."""
    hint: str | None = None


class Layer:
    """One kind of thing to draw. Scene nodes are created once and changed in place."""

    name: ClassVar[str]
    """Name in the scene tree, in `Dashboard.layers` and in `snapshot`."""
    title: ClassVar[str]
    """Name for the user."""
    keys: ClassVar[Sequence[ColorKey]] = ()
    """Legend entries that are the same for all frames."""
    on_by_default: ClassVar[bool] = True
    """True if the layer is visible when the page opens."""
    needs: ClassVar[str] = ""
    """Extension of a plan that the layer draws, of `planners.plan.EXTENSIONS`; empty for what all plans have."""
    needs_samples: ClassVar[bool] = False
    """True if the layer draws the Stage I samples, which frames include only on request."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.available = True
        """True if the source provides the data that the layer draws."""
        self.eyes: Sequence[NDArray[np.float64]] = ()
        """Positions of the cameras of all visitors [m], each of shape [3], world frame."""
        self.history: FlightHistory | None = None
        """Every tick of the source so far; None before the first update."""
        self.options: tuple[Option, ...] = ()
        """Choices that the page offers for this layer."""
        self._root = server.scene.add_frame(f"/{self.name}", show_axes=False, visible=self.on_by_default)
        self._own_roots: dict[int, viser.FrameHandle] = {}
        """The root as each visitor sees it, by the number of the client; viser shows it instead of the shared root."""
        self.create(server.scene)

    @property
    def visible(self) -> bool:
        """True if the layer is updated: a visitor sees it, or the next one will. Setting it sets it for everyone."""
        roots = list(self._own_roots.values())
        return any(root.visible for root in roots) if roots else bool(self._root.visible)

    @visible.setter
    def visible(self, visible: bool) -> None:
        for root in (self._root, *list(self._own_roots.values())):
            root.visible = visible

    def welcome(self, client: viser.ClientHandle) -> None:
        """Let a new visitor show or hide the layer independently of the others."""
        root = client.scene.add_frame(f"/{self.name}", show_axes=False, visible=self._root.visible)
        self._own_roots[client.client_id] = root
        root.visible = self._root.visible  # it may have changed meanwhile, on another thread

    def forget_all_but(self, clients: Mapping[int, viser.ClientHandle]) -> None:
        """Drop the state of visitors who have left."""
        for number in set(self._own_roots) - set(clients):
            self._own_roots.pop(number, None)

    def is_visible_to(self, number: int) -> bool:
        """Return True if the visitor with this number sees the layer."""
        return bool(self._own_roots.get(number, self._root).visible)

    def show_to(self, number: int, visible: bool) -> None:
        """Show the layer to one visitor, or hide it."""
        if number in self._own_roots:
            self._own_roots[number].visible = visible

    @property
    def position(self) -> NDArray[np.float64]:
        """Place of the world's origin in the scene [m], shape [3]; zero unless a recording moves the world."""
        return np.asarray(self._root.position, dtype=np.float64)

    @position.setter
    def position(self, position: NDArray[np.float64]) -> None:
        self._root.position = position

    def create(self, scene: viser.SceneApi) -> None:
        """Create the scene nodes, below `/name`, and the options."""
        raise NotImplementedError

    def on_new_source(self, source: SourceInfo) -> list[Change]:
        """Return the changes that show the constants of another source."""
        return []

    def show(self, frame: Frame) -> list[Change]:
        """Return the changes that show `frame` if the layer is visible, and its plan has what the layer draws."""
        if self.needs:
            self.available = not lacks(frame.plan, self.needs)
        return self.update(frame) if self.visible and (self.available or not self.needs) else []

    def update(self, frame: Frame) -> list[Change]:
        """Return the changes that show `frame`, whose plan has what the layer needs."""
        return []

    def legend(self, frame: Frame) -> Sequence[ColorKey | ColorScale]:
        """Return the meaning of the layer's colours in `frame`."""
        return self.keys

    def chart(self, frame: Frame) -> BarChart | None:
        """Return a chart of `frame` for the status panel, which shows it even while the layer is hidden."""
        return None


def legend_entries(layers: Iterable[Layer], frame: Frame) -> list[ColorKey | ColorScale]:
    """Return the legend of those layers that are shown."""
    return [entry for layer in layers if layer.visible and layer.available for entry in layer.legend(frame)]


class Lines:
    """Line segments in a buffer that only grows, so that its size on the page rarely changes.

    Unused rows repeat the last point: segments of length zero, which draw nothing. The thickness is in pixels, which
    keeps lines legible at any distance and costs half as much as a thickness in metres.
    """

    def __init__(self, scene: viser.SceneApi, name: str, *, thickness: float, capacity: int = 64) -> None:
        self._capacity = capacity
        self._colors: ArrayLike | None = None
        self._colored_size = (0, 0)
        self.node = scene.add_line_segments(
            name,
            np.zeros((capacity, 2, 3), dtype=np.float32),
            np.zeros((capacity, 2, 3), dtype=np.uint8),
            thickness=thickness,
            thickness_units="screen",
            visible=False,
        )

    def show(self, segments: ArrayLike, colors: ArrayLike) -> list[Change]:
        """Return the changes that show line segments.

        Args:
            segments: start and end points [m], shape [n, 2, 3].
            colors: uint8, broadcast to the same shape, as returned by `palette.unmapped`. If this is the same object
                as in the previous call, the colours are not sent again.
        """
        segments = np.asarray(segments, dtype=np.float32)
        count = len(segments)
        if count == 0:
            return [(self.node, "visible", False)]
        while self._capacity < count:
            self._capacity *= 2
        points = np.empty((self._capacity, 2, 3), dtype=np.float32)
        points[:count], points[count:] = segments, segments[-1, 1]
        changes: list[Change] = [(self.node, "points", points), (self.node, "visible", True)]
        # A single colour fills the whole buffer, whatever the count.
        size = (self._capacity, count if np.ndim(colors) > 1 else 0)
        if colors is not self._colors or size != self._colored_size:
            self._colors, self._colored_size = colors, size
            buffer = np.empty((self._capacity, 2, 3), dtype=np.uint8)
            buffer[:count] = colors
            buffer[count:] = buffer[count - 1, 1]
            changes.append((self.node, "colors", buffer))
        return changes


def full_plan(frame: Frame) -> EnsemblePlan:
    """Return the plan of a frame for a layer that needs an extension, and is shown only if the plan has it."""
    return cast(EnsemblePlan, frame.plan)


def relative_to_drone(positions: ArrayLike, frame: Frame) -> NDArray[np.float32]:
    """Return positions [m], shape [.., 3], world frame, relative to the drone, for lines below a node at the drone.

    A browser that draws slowly moves nodes at once and redraws lines later. Lines in the world would then begin where
    the drone was.
    """
    return (np.asarray(positions) - frame.drone_position).astype(np.float32)


def polylines(vertices: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the segments of polylines, shape [..., n, 3] -> [m, 2, 3]."""
    return np.stack((vertices[..., :-1, :], vertices[..., 1:, :]), axis=-2).reshape(-1, 2, 3)


def headroom(eyes: Iterable[NDArray[np.float64]], frame: Frame) -> float | None:
    """Return the height above which nothing may hide the drone from an eye that looks from above [m]; None without one.

    It changes in steps, so that what is drawn below it rarely changes.
    """
    drone = frame.drone_position
    for eye in eyes:
        offset = eye - drone
        if offset[2] > _STEEP * np.hypot(*offset[:2]):
            return float(np.ceil((drone[2] + _HEADROOM) / _HEADROOM_STEP) * _HEADROOM_STEP)
    return None


def view_targets(frame: Frame) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the points that must stay visible and the clearance that each line of sight needs.

    Returns:
        Points [m], shape [n, 3], world frame, and clearances [m], shape [n].
    """
    recorded = frame.recorded_plan
    path = frame.plan.positions[int(frame.plan.best)] if recorded is None else recorded.path
    path = np.asarray(path, dtype=np.float64)
    path = path[[len(path) // 2, -1]]
    return np.vstack((frame.drone_position, path)), np.array([_DRONE_MARGIN, *[_PATH_MARGIN] * len(path)])
