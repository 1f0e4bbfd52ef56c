"""The palette of commands finds tabs, layers and parameters, too; the page can be used by the keyboard alone."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence

import viser

from aero_viz.dashboard.accessibility import NAMES
from aero_viz.dashboard.panels.base import Page, Panel
from aero_viz.dashboard.panels.keys import KEYS
from aero_viz.dashboard.panels.parameters import ParameterPanel
from aero_viz.dashboard.viser_private import run_script

_GO = """
(() => {
  const [title, id] = PLACE;
  const tab = [...document.querySelectorAll("[role=tab]")].find(tab => tab.innerText.trim() === title);
  tab?.dispatchEvent(new KeyboardEvent("keydown", {key: "Enter", bubbles: true}));
  let left = 60;
  const timer = setInterval(() => {
    const target = id ? document.getElementById(id) : tab;
    if (target?.checkVisibility()) {
      target.scrollIntoView({block: "center"});
      target.focus();
      if (document.activeElement === target) left = 0;
    }
    if (left-- <= 0) clearInterval(timer);
  }, 100);
})();
"""
"""Script that opens the tab with a title, and focuses an element in it, or else the tab, once the palette is closed."""


class FinderPanel(Panel):
    """Offers each visitor a command for every tab, every layer without a key, and every parameter.

    Args:
        page: page of the panel.
        tabs: titles of the tabs.
        toggle: shows a layer to a visitor, or hides it, by its name; None without switches.
        parameters: the panel with the parameters, and the title of its tab; None without.
    """

    def __init__(
        self,
        page: Page,
        tabs: Sequence[str],
        toggle: Callable[[viser.ClientHandle, str], object] | None,
        parameters: tuple[ParameterPanel, str] | None,
    ) -> None:
        self._tabs, self._toggle, self._parameters = tabs, toggle, parameters
        super().__init__(page)

    def create(self, gui: viser.GuiApi) -> None:
        pass

    def welcome(self, client: viser.ClientHandle) -> None:
        run_script(client, NAMES)
        with client.atomic():
            for title in self._tabs:
                _offer(client, f"Tab: {title}", lambda title=title: _go(client, title))
            if self._toggle is not None:
                self._offer_layers(client, self._toggle)
            if self._parameters is not None:
                self._offer_parameters(client, *self._parameters)

    def _offer_layers(self, client: viser.ClientHandle, toggle: Callable[[viser.ClientHandle, str], object]) -> None:
        keyed = {key.argument for key in KEYS if key.action == "layer"}
        for name, layer in self.page.layers.items():
            if name not in keyed:
                _offer(client, f"Layer: {layer.title}", lambda name=name: toggle(client, name))

    def _offer_parameters(self, client: viser.ClientHandle, panel: ParameterPanel, title: str) -> None:
        for info in self.session.config.parameters():

            def show(path: str = info.path) -> None:
                if (element := panel.find(client, path)) is not None:
                    _go(client, title, element)

            # The palette ranks words in short labels first, and those in a description above all: keys stay before.
            _offer(client, f"Parameter: {info.title}, {info.path}", show)


def _offer(client: viser.ClientHandle, label: str, action: Callable[[], object]) -> None:
    @client.gui.add_command(label).on_trigger
    async def _(_: viser.CommandEvent) -> None:
        action()


def _go(client: viser.ClientHandle, title: str, element: str | None = None) -> None:
    run_script(client, _GO.replace("PLACE", json.dumps([title, element])))
