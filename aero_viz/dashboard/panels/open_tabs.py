"""The tab that each visitor has open, which the page itself does not tell the server."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Mapping, Sequence

import viser

from aero_viz.dashboard.panels.base import Page, Panel
from aero_viz.dashboard.viser_private import identifier, run_script

_SCRIPT = """
(() => {
  const buttons = BUTTONS;
  let told = null;
  const tell = () => {
    const open = [...document.querySelectorAll("[role=tab][aria-selected=true]")].map(tab => tab.innerText.trim());
    const name = open.find(name => name in buttons), button = document.getElementById(buttons[name]);
    if (!button || name === told) return;
    told = name;
    button.click();
  };
  const style = document.createElement("style");
  style.textContent = Object.values(buttons).map(id => `div:has(> #${CSS.escape(id)}) {display: none}`).join(" ");
  document.head.append(style);
  window.aeroOpenTab?.();
  const observer = new MutationObserver(tell), timer = setInterval(tell, 500);
  observer.observe(document.body, {subtree: true, attributes: true, attributeFilter: ["aria-selected"]});
  window.aeroOpenTab = () => { observer.disconnect(); clearInterval(timer); style.remove(); };
})();
"""
"""Script that presses the hidden button of the tab that is open. `BUTTONS` are the ids of the buttons by tab."""


class OpenTabs(Panel):
    """Knows which tab each visitor has open, by buttons that a script on the page hides and presses.

    Args:
        page: page of the panel.
        names: names of the tabs.
    """

    def __init__(self, page: Page, names: Sequence[str]) -> None:
        self._names = names
        self._open: dict[int, str] = {}
        self._lock = threading.Lock()
        self._callbacks: list[Callable[[], None]] = []
        super().__init__(page)

    def create(self, gui: viser.GuiApi) -> None:
        self._order = gui.add_html("", visible=False).order

    def on_change(self, callback: Callable[[], None]) -> None:
        """Call `callback` when a visitor opens another tab or leaves."""
        self._callbacks.append(callback)

    def is_open(self, name: str, number: int | None = None) -> bool:
        """Return True if a visitor has the tab `name` open: the one with this number, or any one for None.

        While there are no visitors, every tab counts as open.
        """
        with self._lock:
            if number is not None:
                return self._open.get(number) == name
            return not self._open or name in self._open.values()

    def welcome(self, client: viser.ClientHandle) -> None:
        buttons = {name: self._add(client, name) for name in self._names}
        run_script(client, _SCRIPT.replace("BUTTONS", json.dumps(buttons)))

    def _add(self, client: viser.ClientHandle, name: str) -> str:
        """Add the button of a tab, and return the id of its element on the page."""
        button = client.gui.add_button(f"Tab {name}", order=self._order)

        @button.on_click
        async def _(_: viser.GuiEvent) -> None:
            with self._lock:
                self._open[client.client_id] = name
            self._tell()

        return identifier(button)

    def forget_all_but(self, clients: Mapping[int, viser.ClientHandle]) -> None:
        with self._lock:
            left = set(self._open) - set(clients)
            for number in left:
                del self._open[number]
        if left:
            self._tell()

    def _tell(self) -> None:
        for callback in self._callbacks:
            callback()
