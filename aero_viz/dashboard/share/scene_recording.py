"""Recording of the scene during a flight, which viser's client plays without a server."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from aero_planner.sweeps import Sweeps
from aero_viz.dashboard.history import FlightHistory
from aero_viz.dashboard.layers import LAYERS, Change, Layer, apply, known_names
from aero_viz.dashboard.layers.cloud import CloudLayer
from aero_viz.dashboard.panels.camera import FIELD_OF_VIEW, Viewpoints
from aero_viz.dashboard.server import LocalServer
from aero_viz.dashboard.share.legend import RecordedLegend
from aero_viz.dashboard.share.page import REWOUND
from aero_viz.dashboard.viser_private import run_script
from aero_viz.errors import UserError
from aero_viz.session.frame import Frame

_MOST_POINTS = 16_000
"""Points of a shared cloud."""
_CLOUD_PERIOD = 0.2
"""Time between two clouds [s]. Clouds are most of a file."""
_RESOLUTION = 256.0
"""Steps per metre to which places are rounded, so that they compress well [1/m]."""


class _SharedCloudLayer(CloudLayer):
    """The cloud with fewer points. Each sweep keeps the same ones, because unchanged data is stored only once."""

    name, title = CloudLayer.name, CloudLayer.title

    def thinned(self, cloud: Sweeps) -> NDArray[np.float32]:
        step = max(-(-cloud.point_count // _MOST_POINTS), 1)
        step = 1 << (step - 1).bit_length()  # changes rarely while the cloud grows
        points = np.concatenate([np.zeros((0, 3), np.float32), *(sweep[::step] for sweep in cloud)])
        return points[np.isfinite(points[:, 0])]


class SceneRecording:
    """Records the scene of one frame after the other. The drone stays in the middle, and the world moves past it.

    A viewer of the recording can therefore turn the camera with the mouse while it follows the drone.

    Args:
        layers: names of the layers to show; None shows those that are on by default.

    Raises:
        UserError: there is no such layer; lists them.
    """

    def __init__(self, layers: Sequence[str] | None = None) -> None:
        self._server = LocalServer(port=0)
        kinds = [_SharedCloudLayer if kind is CloudLayer else kind for kind in LAYERS.values()]
        self._layers: dict[str, Layer] = {kind.name: kind(self._server) for kind in kinds}
        try:
            self._chosen = None if layers is None else known_names(layers, self._layers)
        except UserError:
            self.close()
            raise
        self.legend = RecordedLegend()
        """Meaning of the colours."""
        self._history = FlightHistory()
        self._views = Viewpoints()
        self._origin: NDArray[np.float64] | None = None
        self._last: Frame | None = None
        self._cloud_due = -np.inf
        self._started = 0.0
        run_script(self._server, REWOUND)
        self._serializer = self._server.get_scene_serializer()

    @property
    def duration(self) -> float:
        """Duration of the recording [s]."""
        return 0.0 if self._last is None else self._last.time - self._started

    def add(self, frame: Frame) -> None:
        """Record the scene at a tick, later than the one before."""
        position = frame.drone_position
        if self._last is None:
            self._start(frame, position)
        else:
            self._serializer.insert_sleep(max(frame.time - self._last.time, 0.0))
        self._history.add(frame)
        assert self._origin is not None
        changes = self._changes(frame)
        for layer in self._layers.values():
            layer.position = self._origin - position
        apply((handle, name, _rounded(value)) for handle, name, value in changes)
        self.legend.add(self._layers.values(), frame)
        self._last = frame

    def _start(self, frame: Frame, position: NDArray[np.float64]) -> None:
        self._origin, self._started = position, frame.time
        eye, target = self._views.find("follow", frame)
        camera = self._server.initial_camera
        camera.fov, camera.position, camera.look_at = FIELD_OF_VIEW, eye, target
        for name, layer in self._layers.items():
            layer.visible = layer.on_by_default if self._chosen is None else name in self._chosen
            apply(layer.on_new_source(frame.source))

    def _changes(self, frame: Frame) -> list[Change]:
        eye, _ = self._views.find("follow", frame)
        changes: list[Change] = []
        for name, layer in self._layers.items():
            if not (layer.visible and layer.available):
                continue
            if name == CloudLayer.name:
                if frame.time < self._cloud_due:
                    continue
                self._cloud_due = frame.time + _CLOUD_PERIOD - 1e-6
            layer.eyes = [eye] if name != CloudLayer.name else []
            layer.history = self._history
            changes += layer.show(frame)
        return changes

    def as_html(self) -> str:
        """Return a web page that plays the recording; nothing can be added afterwards."""
        self._serializer.insert_sleep(0.5)  # the end stays in view before the recording starts over
        return self._serializer.as_html(dark_mode=True)

    def close(self) -> None:
        """Stop the server that the recording is taken from."""
        self._server.stop()


def _rounded(value: object) -> object:
    """Return an array of places rounded to `_RESOLUTION`; anything else as it is."""
    if isinstance(value, np.ndarray) and value.dtype == np.float32 and value.ndim >= 2 and value.shape[-1] == 3:
        return np.round(value * _RESOLUTION) / np.float32(_RESOLUTION)
    return value
