"""Visitors who load the page again find their camera and their layers as they were."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Mapping
from dataclasses import dataclass

import viser

from aero_viz.dashboard.panels.base import Page, Panel
from aero_viz.dashboard.panels.camera import CameraPanel, CameraPlace
from aero_viz.dashboard.viser_private import run_script

_ITEM = "aero-visit"
_STORE = f"""
sessionStorage.aeroVisit ??= Math.random().toString(36).slice(2) + Date.now().toString(36);
localStorage.setItem("viser-user:{_ITEM}", sessionStorage.aeroVisit);
"""
"""Script that gives a tab of the browser a name, which it keeps until it is closed."""
_ANSWER_MAX = 20.0
"""Longest wait for the answer of a page [s]."""
_MOST = 100
"""Largest number of visitors who have left and are remembered."""


@dataclass(frozen=True)
class _View:
    """What a visitor saw."""

    camera: CameraPlace
    layers: Mapping[str, bool]


class ReturningVisitors(Panel):
    """Remembers the views of visitors who leave, by the tab of their browser; the page itself keeps its open tab."""

    def __init__(self, page: Page, camera: CameraPanel) -> None:
        self._camera = camera
        self._names: dict[int, str] = {}
        """Name of the browser's tab, by the number of the client."""
        self._clients: dict[int, viser.ClientHandle] = {}
        self._views: dict[str, _View] = {}
        super().__init__(page)

    def create(self, gui: viser.GuiApi) -> None:
        pass

    def welcome(self, client: viser.ClientHandle) -> None:
        run_script(client, _STORE)
        threading.Thread(target=self._welcome, args=(client,), name="aero-viz-return", daemon=True).start()

    def _welcome(self, client: viser.ClientHandle) -> None:
        with contextlib.suppress(RuntimeError, TimeoutError):  # the page was closed, or stores nothing
            name = client.local_storage.get_item(_ITEM, timeout=_ANSWER_MAX)
            if not name:
                return
            before = [number for number, other in self._names.items() if other == name]
            self._names[client.client_id], self._clients[client.client_id] = name, client
            # The page may be here again before the server notices that it has left.
            view = self._view_of(self._clients[before[-1]]) if before else self._views.pop(name, None)
            if view is None:
                return
            self._camera.place(client, view.camera)
            for layer in self.page.layers.values():
                if layer.name in view.layers:
                    layer.show_to(client.client_id, view.layers[layer.name])
            self.page.update_samples()
            self.page.refresh()

    def forget_all_but(self, clients: Mapping[int, viser.ClientHandle]) -> None:
        for number in set(self._names) - set(clients):
            name, client = self._names.pop(number), self._clients.pop(number)
            self._views[name] = self._view_of(client)
            while len(self._views) > _MOST:
                del self._views[next(iter(self._views))]

    def _view_of(self, client: viser.ClientHandle) -> _View:
        layers = {layer.name: layer.is_visible_to(client.client_id) for layer in self.page.layers.values()}
        return _View(self._camera.place_of(client), layers)
