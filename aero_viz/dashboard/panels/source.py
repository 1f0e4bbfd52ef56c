"""Choice of the source."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError

import viser

from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.base import Page, Panel
from aero_viz.dashboard.server import notify
from aero_viz.session.base import SessionControls
from aero_viz.session.source import Opener, Source

__all__ = ["SourcePanel"]


class SourcePanel(Panel):
    """Opens scenes and recordings. If one cannot be opened, the page says why and the current source continues."""

    def __init__(
        self,
        page: Page,
        controls: SessionControls,
        open_source: Opener,
        choices: Sequence[tuple[str, str]],
        *,
        seed: int,
    ) -> None:
        self._controls = controls
        self._open_source = open_source
        self._first_seed = seed
        # A dropdown cuts off long entries: it gets the names, and a line below it gets the descriptions.
        split = [(*label.partition(": "), spec) for label, spec in choices]
        self._choices = {name: (description, spec) for name, _, description, spec in split}
        super().__init__(page)

    def create(self, gui: viser.GuiApi) -> None:
        hint = "Seed of the scene, the LiDAR and all noise. Another seed gives another forest."
        self._seed = gui.add_number("Seed", self._first_seed, min=0, step=1, hint=hint)
        if self._choices:
            choice = gui.add_dropdown("Scene", tuple(self._choices), hint="Scenes and recordings to open.")
            description = gui.add_html(markup.note(self._choices[choice.value][0]))

            @choice.on_update
            async def _(_: viser.GuiEvent) -> None:
                description.content = markup.note(self._choices[choice.value][0])

            open_choice = gui.add_button("Open", icon=viser.Icon.PLAYER_EJECT, color="gray")

            @open_choice.on_click
            async def _(event: viser.GuiEvent) -> None:
                self._start_opening(self._choices[choice.value][1], event.client)

        path = gui.add_text("Path", "", hint="Path of a recording or a world on this machine, or the name of a scene.")
        open_path = gui.add_button("Open path", icon=viser.Icon.FOLDER_OPEN, color="gray")

        @open_path.on_click
        async def _(event: viser.GuiEvent) -> None:
            self._start_opening(path.value.strip(), event.client)

    def _start_opening(self, spec: str, client: viser.ClientHandle | None) -> None:
        """Open a source on a daemon thread. The program would wait for viser's thread pool at exit."""
        threading.Thread(target=self.open, args=(spec, client), name="aero-viz-open", daemon=True).start()

    def open(self, spec: str, client: viser.ClientHandle | None) -> None:
        """Open a source by name or path and make it the session's; problems are shown to `client`."""
        if not spec:
            notify(self.page.server, "Enter the path of a recording or a world first.", level="error", client=client)
            return
        seed = int(self._seed.value)
        with self._loading_notification(f"Opening {spec} ..", client):
            opened: list[Source] = []
            if self.page.attempt(lambda: opened.append(self._open_source(spec, seed=seed)), client):
                # If its first tick fails, the session notifies everyone.
                with contextlib.suppress(CancelledError):  # the session was closed in the meantime
                    self._controls.set_source(opened[0]).exception()
                self.page.refresh()

    @contextlib.contextmanager
    def _loading_notification(self, text: str, client: viser.ClientHandle | None) -> Iterator[None]:
        """Show `text` with a spinner to `client`, or to everyone, during the context."""
        clients = [client] if client is not None else list(self.page.server.get_clients().values())
        shown = [c.add_notification("AERO-Viz", text, loading=True, with_close_button=False) for c in clients]
        try:
            yield
        finally:
            for notification in shown:
                notification.remove()
