"""Choice of what is flown or played."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError

import viser

from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.base import Page, Panel
from aero_viz.dashboard.server import notify
from aero_viz.session.source import Opener, Source

__all__ = ["SourcePanel"]


class SourcePanel(Panel):
    """Opens scenes and recordings. What cannot be opened is said so, and the present source goes on."""

    def __init__(self, page: Page, open_source: Opener, choices: Sequence[tuple[str, str]], *, seed: int) -> None:
        self._open_source = open_source
        self._first_seed = seed
        # A dropdown cuts off what is long: it gets the names, and what they stand for is told below.
        split = [(*label.partition(": "), spec) for label, spec in choices]
        self._choices = {name: (about, spec) for name, _, about, spec in split}
        super().__init__(page)

    def create(self, gui: viser.GuiApi) -> None:
        hint = "Of the scene, the LiDAR and all noise: another seed, another forest."
        self._seed = gui.add_number("Seed", self._first_seed, min=0, step=1, hint=hint)
        if self._choices:
            offer = gui.add_dropdown("On offer", tuple(self._choices), hint="Scenes and recordings.")
            about = gui.add_html(markup.note(self._choices[offer.value][0]))

            @offer.on_update
            async def _(_: viser.GuiEvent) -> None:
                about.content = markup.note(self._choices[offer.value][0])

            offer_open = gui.add_button("Open", icon=viser.Icon.PLAYER_EJECT, color="gray")

            @offer_open.on_click
            async def _(event: viser.GuiEvent) -> None:
                self._start(self._choices[offer.value][1], event.client)

        path = gui.add_text("Path", "", hint="A recording or a world on this machine, or the name of a scene.")
        path_open = gui.add_button("Open path", icon=viser.Icon.FOLDER_OPEN, color="gray")

        @path_open.on_click
        async def _(event: viser.GuiEvent) -> None:
            self._start(path.value.strip(), event.client)

    def _start(self, spec: str, client: viser.ClientHandle | None) -> None:
        """Open in a thread of its own, for which the program's end does not wait as it does for viser's pool."""
        threading.Thread(target=self._open, args=(spec, client), name="aero-viz-open", daemon=True).start()

    def _open(self, spec: str, client: viser.ClientHandle | None) -> None:
        if not spec:
            notify(self.page.server, "Give the path of a recording or a world first.", level="error", client=client)
            return
        seed = int(self._seed.value)
        with self._told_to_wait(spec, client):
            source: list[Source] = []
            if self.page.attempt(lambda: source.append(self._open_source(spec, seed=seed)), client):
                # Should its first tick fail, the session says so to everyone.
                with contextlib.suppress(CancelledError):  # the session was closed meanwhile
                    self.session.set_source(source[0]).exception()
                self.page.refresh()

    @contextlib.contextmanager
    def _told_to_wait(self, spec: str, client: viser.ClientHandle | None) -> Iterator[None]:
        """Let `client`, or everyone, see that `spec` is being opened."""
        clients = [client] if client is not None else list(self.page.server.get_clients().values())
        text = f"Opening {spec} .."
        shown = [one.add_notification("AERO-Viz", text, loading=True, with_close_button=False) for one in clients]
        try:
            yield
        finally:
            for notification in shown:
                notification.remove()
