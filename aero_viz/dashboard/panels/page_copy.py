"""A copy of a visitor's page, for a picture of what this visitor sees."""

from __future__ import annotations

import contextlib
import json
import secrets
import threading
from collections.abc import Iterator

import viser

from aero_planner.user_file import parse_json
from aero_viz.dashboard.page_view import PageView
from aero_viz.dashboard.panels.base import Page, Panel
from aero_viz.dashboard.panels.camera import CameraPanel
from aero_viz.dashboard.viser_private import run_script, wait_until_drawn

_SIZE_MIN, _SIZE_MAX = 300, 4000
_TOKEN, _VIEW = "aero-copy", "aero-view"
"""Items of a browser's storage: the token of a copy, empty once it is complete, and the state of a page."""
_KEPT = ("aero-tab ", "viser-user:theme", "aero-curves")
"""Beginnings of the names of the items that a copy takes over."""
_ANSWER_MAX = 20.0
"""Longest wait for the answer of a page [s]."""
_STORE_VIEW = f"""
const items = {{}};
for (const list of document.querySelectorAll("[role=tablist]")) {{
  const tabs = [...list.querySelectorAll("[role=tab]")], open = tabs.find(tab => tab.ariaSelected === "true");
  if (open) items["aero-tab " + tabs[0].innerText.trim()] = open.innerText.trim();
}}
for (const key of ["viser-user:theme", "aero-curves"]) {{
  const item = localStorage.getItem(key);
  if (item !== null) items[key] = item;
}}
localStorage.setItem("viser-user:{_VIEW}", JSON.stringify({{width: innerWidth, height: innerHeight, items}}));
"""
"""Script that stores the size, the open tabs, the theme and the curves of a page."""


class PageCopies(Panel):
    """Shows on a page that is opened for a picture what a visitor sees: camera, layers, open tabs and theme.

    The page is told from those of visitors by a token, and is not counted as one.
    """

    def __init__(self, page: Page, camera: CameraPanel) -> None:
        self._camera = camera
        self._originals: dict[str, viser.ClientHandle] = {}
        """Visitors whose page is copied, by the token of the copy."""
        super().__init__(page)

    def create(self, gui: viser.GuiApi) -> None:
        pass

    @contextlib.contextmanager
    def copy(self, client: viser.ClientHandle) -> Iterator[PageView]:
        """Yield the view of a page that becomes a copy of a visitor's page if it is opened during the context."""
        run_script(client, _STORE_VIEW)
        answer = client.local_storage.get_item(_VIEW, timeout=_ANSWER_MAX)
        size, storage = _parse(answer or "")
        token = secrets.token_urlsafe(16)
        self._originals[token] = client
        try:
            key = f"viser-user:{_TOKEN}"
            yield PageView(size, {**storage, key: token}, is_ready=f"localStorage.getItem({json.dumps(key)}) === ''")
        finally:
            del self._originals[token]

    def welcome(self, client: viser.ClientHandle) -> None:
        if self._originals:
            threading.Thread(target=self._welcome, args=(client,), name="aero-viz-copy", daemon=True).start()

    def _welcome(self, client: viser.ClientHandle) -> None:
        with contextlib.suppress(RuntimeError, TimeoutError):  # the page was closed, or stores nothing
            original = self._originals.get(client.local_storage.get_item(_TOKEN, timeout=_ANSWER_MAX) or "")
            if original is None:
                return
            self.page.server.visitors.exclude(client.client_id)
            self._camera.copy(original, client)
            for layer in self.page.layers.values():
                layer.show_to(client.client_id, layer.is_visible_to(original.client_id))
            self.page.refresh()
            wait_until_drawn(client)
            client.local_storage.set_item(_TOKEN, "")


def _parse(answer: str) -> tuple[tuple[int, int], dict[str, str]]:
    """Return the size and the stored items that a page has sent.

    Raises:
        ValueError: it has sent something else.
    """
    match parse_json(answer):
        case {"width": int(width), "height": int(height), "items": dict(items)}:
            kept = {str(key): str(value) for key, value in items.items() if str(key).startswith(_KEPT)}
            return (_fitted(width), _fitted(height)), kept
    raise ValueError("the page does not say what it shows")


def _fitted(length: int) -> int:
    return min(max(length, _SIZE_MIN), _SIZE_MAX)
