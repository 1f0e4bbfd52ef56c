"""Choice of what is flown or played."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import viser

from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.base import Page, Panel
from aero_viz.dashboard.server import notify
from aero_viz.source import Source

__all__ = ["SourcePanel"]


class SourcePanel(Panel):
    """Opens scenes and recordings. What cannot be opened is said so, and the present source goes on."""

    def __init__(self, page: Page, open_source: Callable[[str], Source], choices: Sequence[tuple[str, str]]) -> None:
        self._open_source = open_source
        # A dropdown cuts off what is long: it gets the names, and what they stand for is told below.
        split = [(*label.partition(": "), spec) for label, spec in choices]
        self._choices = {name: (about, spec) for name, _, about, spec in split}
        super().__init__(page)

    def create(self, gui: viser.GuiApi) -> None:
        if self._choices:
            offer = gui.add_dropdown("On offer", tuple(self._choices), hint="Scenes and recordings.")
            about = gui.add_html(markup.note(self._choices[offer.value][0]))

            @offer.on_update
            async def _(_: viser.GuiEvent) -> None:
                about.content = markup.note(self._choices[offer.value][0])

            offer_open = gui.add_button("Open", icon=viser.Icon.PLAYER_EJECT, color="gray")
            offer_open.on_click(lambda event: self._open(self._choices[offer.value][1], event.client))
        path = gui.add_text("Path", "", hint="A recording or a world on this machine, or the name of a scene.")
        path_open = gui.add_button("Open path", icon=viser.Icon.FOLDER_OPEN, color="gray")
        path_open.on_click(lambda event: self._open(path.value.strip(), event.client))

    def _open(self, spec: str, client: viser.ClientHandle | None) -> None:
        """Runs in viser's pool, as opening takes time."""
        if not spec:
            notify(self.page.server, "Give the path of a recording or a world first.", level="error", client=client)
            return
        source: list[Source] = []
        if self.page.attempt(lambda: source.append(self._open_source(spec)), client):
            # Should its first tick fail, the session says so to everyone.
            self.session.set_source(source[0]).exception()
            self.page.refresh()
