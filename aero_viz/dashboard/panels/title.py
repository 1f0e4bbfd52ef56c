"""The title of the browser tab."""

from __future__ import annotations

import json

import viser

from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.panels.base import Panel
from aero_viz.dashboard.viser_private import run_script
from aero_viz.session.source import SourceInfo

PRODUCT = "AERO-Viz"


def title(source: str) -> str:
    """Return the title of a page that shows a source with this name."""
    return f"{source} - {PRODUCT}"


class TitlePanel(Panel):
    """The title of the browser tab, which names the source."""

    def create(self, gui: viser.GuiApi) -> None:
        self._title = PRODUCT

    def welcome(self, client: viser.ClientHandle) -> None:
        run_script(client, f"document.title = {json.dumps(self._title)}")

    def on_new_source(self, source: SourceInfo) -> list[Change]:
        self._title = title(source.name)
        for client in self.page.server.get_clients().values():
            self.welcome(client)
        return []
