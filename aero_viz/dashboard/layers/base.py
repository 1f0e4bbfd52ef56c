"""What all layers share: a node with a visibility, and line segments in a buffer of fixed size."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, ClassVar

import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray

from aero_viz.session.frame import Frame
from aero_viz.session.source import Source

__all__ = ["Change", "Layer", "Lines", "apply", "polylines"]

Change = tuple[Any, str, Any]
"""Handle, property, new value: computed first, then all assigned at once."""


def apply(changes: Iterable[Change]) -> None:
    """Assign every change; viser sends only what differs."""
    for handle, name, value in changes:
        setattr(handle, name, value)


class Layer:
    """One kind of thing to draw. Nodes are made once and changed in place."""

    name: ClassVar[str]
    """Name in the scene tree, in `Dashboard.layers` and in `snapshot`."""
    title: ClassVar[str]
    """Name for the user."""
    on: ClassVar[bool] = True
    """Whether it is shown when the page opens."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.available = True
        """Whether the source has what the layer shows."""
        self._root = server.scene.add_frame(f"/{self.name}", show_axes=False, visible=self.on)
        self.create(server.scene)

    @property
    def visible(self) -> bool:
        """Whether the layer is shown, and updated."""
        return bool(self._root.visible)

    @visible.setter
    def visible(self, visible: bool) -> None:
        self._root.visible = visible

    def create(self, scene: viser.SceneApi) -> None:
        """Make the nodes, below `/name`."""
        raise NotImplementedError

    def enter(self, source: Source) -> list[Change]:
        """Return the changes that another source brings."""
        return []

    def update(self, frame: Frame) -> list[Change]:
        """Return the changes that show `frame`."""
        return []


class Lines:
    """Line segments in a buffer that only ever grows, so that the page seldom sees another size.

    Rows without data repeat the last point: segments of length zero, which draw nothing. The thickness is in pixels:
    lines stay legible at any distance, and cost half of what lines in metres do.
    """

    def __init__(self, scene: viser.SceneApi, name: str, *, thickness: float, capacity: int = 64) -> None:
        self._capacity = capacity
        self._colors: ArrayLike | None = None
        self._painted = (0, 0)
        self.node = scene.add_line_segments(
            name,
            np.zeros((capacity, 2, 3), dtype=np.float32),
            np.zeros((capacity, 2, 3), dtype=np.uint8),
            thickness=thickness,
            thickness_units="screen",
            visible=False,
        )

    def show(self, segments: ArrayLike, colors: ArrayLike) -> list[Change]:
        """Return the changes that show `segments` [m], shape [n, 2, 3].

        Args:
            segments: from where to where.
            colors: uint8, broadcast to the same shape; as `palette.unmapped` makes them. Those of the call before, the
                same object, are not sent again.
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
        # One colour fills the whole buffer, whatever the count.
        size = (self._capacity, count if np.ndim(colors) > 1 else 0)
        if colors is not self._colors or size != self._painted:
            self._colors, self._painted = colors, size
            paint = np.empty((self._capacity, 2, 3), dtype=np.uint8)
            paint[:count] = colors
            paint[count:] = paint[count - 1, 1]
            changes.append((self.node, "colors", paint))
        return changes


def polylines(vertices: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the segments of polylines, shape [..., n, 3] -> [m, 2, 3]."""
    return np.stack((vertices[..., :-1, :], vertices[..., 1:, :]), axis=-2).reshape(-1, 2, 3)
