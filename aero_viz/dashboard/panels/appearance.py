"""Light or dark panels and scene, and the open tabs: each browser remembers its own."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Mapping

import viser

from aero_viz.dashboard.panels.base import Panel
from aero_viz.dashboard.scene_style import style_scene
from aero_viz.dashboard.server import configure_theme
from aero_viz.dashboard.viser_private import run_script

_THEME = "theme"
_ANSWER_MAX = 60.0
"""Longest wait for a browser's stored value [s]."""
_TABS = """
if (!window.aeroTabs) {
  window.aeroTabs = new Set();
  const groups = () => [...document.querySelectorAll("[role=tablist]")]
    .map(list => [...list.querySelectorAll("[role=tab]")]).filter(tabs => tabs.length);
  const name = tab => tab.innerText.trim(), key = tabs => "aero-tab " + name(tabs[0]);
  const isOpen = tab => tab.ariaSelected === "true";
  const note = () => groups().forEach(tabs => {
    const open = tabs.find(isOpen);
    if (open) localStorage.setItem(key(tabs), name(open));
  });
  for (const kind of ["pointerup", "keyup"])
    addEventListener(kind, event => event.isTrusted && setTimeout(note, 300), true);
  const restore = setInterval(() => groups().forEach(tabs => {
    if (window.aeroTabs.has(key(tabs))) return;
    window.aeroTabs.add(key(tabs));
    const tab = tabs.find(tab => name(tab) === localStorage.getItem(key(tabs)) && !isOpen(tab));
    tab?.dispatchEvent(new KeyboardEvent("keydown", {key: "Enter", bubbles: true}));
  }), 200);
  addEventListener("pointerdown", () => clearInterval(restore), {capture: true, once: true});
}
"""
"""Script that notes the tab that a user opens, by the first tab of its group, and opens it when the page is loaded."""


class AppearancePanel(Panel):
    """Switches the panels and the scene of a visitor between light and dark."""

    def create(self, gui: viser.GuiApi) -> None:
        self._light: set[int] = set()

    def welcome(self, client: viser.ClientHandle) -> None:
        run_script(client, _TABS)
        threading.Thread(target=self._restore, args=(client,), name="aero-viz-appearance", daemon=True).start()

    def _restore(self, client: viser.ClientHandle) -> None:
        """Use the theme that the visitor's browser remembers. Runs on a thread: the answer takes a while."""
        with contextlib.suppress(RuntimeError, TimeoutError):  # a visitor who has left, or whose browser keeps nothing
            if client.local_storage.get_item(_THEME, timeout=_ANSWER_MAX) == "light":
                self._use(client, light=True)

    def toggle(self, client: viser.ClientHandle) -> None:
        """Switch a visitor's page between light and dark, and let the browser remember it."""
        light = client.client_id not in self._light
        self._use(client, light=light)
        client.local_storage.set_item(_THEME, "light" if light else "dark")

    def _use(self, client: viser.ClientHandle, *, light: bool) -> None:
        (self._light.add if light else self._light.discard)(client.client_id)
        configure_theme(client.gui, light=light)
        style_scene(client.scene, light=light)

    def forget_all_but(self, clients: Mapping[int, viser.ClientHandle]) -> None:
        self._light &= set(clients)
