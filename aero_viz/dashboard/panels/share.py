"""Buttons that write the flight to a file, and a link to the present moment."""

from __future__ import annotations

import json
import logging
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from pathlib import Path
from typing import Protocol

import viser

from aero_planner.config import DroneConfig
from aero_viz.catalog import open_source
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.links import Link, Opening
from aero_viz.dashboard.page_view import PageView
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.base import Page, Panel
from aero_viz.dashboard.panels.file_progress import FileProgress
from aero_viz.dashboard.panels.page_copy import PageCopies
from aero_viz.dashboard.panels.source import SourcePanel
from aero_viz.dashboard.server import notify
from aero_viz.dashboard.viser_private import run_script
from aero_viz.errors import UserError
from aero_viz.flight import FlightSource
from aero_viz.flight.known_drone import config_without_facts
from aero_viz.session.base import SessionControls
from aero_viz.session.frame import Frame
from aero_viz.session.repeat import repeat
from aero_viz.session.source import SourceInfo
from aero_viz.session.timeline import Checkpoint

_log = logging.getLogger(__name__)
_KINDS = {
    "Web page": (".html", viser.Icon.WORLD, "The flight so far as one file that plays in any browser, offline."),
    "Video": (".mp4", viser.Icon.MOVIE, "The flight so far as a video. Takes a minute or more."),
    "Picture": (".png", viser.Icon.PHOTO, "This moment as you see it, with the panels."),
    "Log": (".mcap", viser.Icon.FILE_DOWNLOAD, "The flight so far for play, Foxglove, RViz and others."),
}
Ticks = Sequence[tuple[Checkpoint, DroneConfig]]
"""Ticks of a session, each with the configuration of its last plan."""
_STORED = "aero-link"
_TAKE_LINK = """
if (location.search.includes("source=")) {
  localStorage.setItem("viser-user:aero-link", location.search);
  history.replaceState(null, "", location.pathname);
}
"""
"""Script that hands over the link of a page's address, once."""
_COPY_LINK = """
const area = document.createElement("textarea");
area.value = location.origin + location.pathname + QUERY;
document.body.append(area);
area.select();
document.execCommand("copy");
area.remove();
"""
"""Script that copies a link; the clipboard's own interface needs HTTPS."""
_COPIED = (
    "The link is in the clipboard. It flies to this time with the present parameters from the start on. Goals and "
    "obstacles that were set on the page are not in it."
)
_LINK_TIMEOUT = 20.0
"""Longest wait for the answer of a page [s]."""
_CLOSE_TIMEOUT = 5.0
"""Longest wait for a file that is given up [s]: a video takes a second for each of its pictures at most."""


class Files(Protocol):
    """Writes files."""

    def write(
        self,
        frames: Iterable[Frame],
        path: Path,
        *,
        command: str,
        layers: Sequence[str],
        report: Callable[[float], None],
    ) -> None:
        """Write frames to a file, in the format that the suffix of its name selects."""

    def picture(self, url: str, view: PageView) -> bytes:
        """Return a picture of the page at an address as PNG."""
        ...


class SharePanel(Panel):
    """Writes the flight so far to a file for the visitor who asks, while the session goes on.

    Its ticks are planned again on a separate source, so that changes of parameters and of the goal are in the
    file as they were.
    """

    def __init__(
        self, page: Page, controls: SessionControls, sources: SourcePanel, files: Files, copies: PageCopies
    ) -> None:
        self._controls, self._sources, self._files, self._copies = controls, sources, files, copies
        self._busy = threading.Lock()
        self._writing: threading.Thread | None = None
        super().__init__(page)

    def create(self, gui: viser.GuiApi) -> None:
        for label, kind in _KINDS.items():
            icon, hint = kind[1:]
            button = gui.add_button(label, icon=icon, color="gray", hint=hint)

            @button.on_click
            async def _(event: viser.GuiEvent, label: str = label) -> None:
                if event.client is not None:
                    self._start(label, event.client)

        self._progress = FileProgress(gui)
        self._link = gui.add_text("Link", "", disabled=True, hint="Opens this source, seed, time and configuration.")
        copy = gui.add_button("Copy link", icon=viser.Icon.LINK, color="gray", hint="Copy the link to this moment.")

        @copy.on_click
        async def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                run_script(event.client, _COPY_LINK.replace("QUERY", json.dumps(self._query())))
                notify(self.page.server, _COPIED, client=event.client)

    def update(self, frame: Frame) -> list[Change]:
        return [] if self.session.playing else [(self._link, "value", self.page.server.url + "/" + self._query())]

    def welcome(self, client: viser.ClientHandle) -> None:
        """Ask a new visitor who came by a link whether to open it: another page may have made the link."""
        threading.Thread(target=self._welcome, args=(client,), name="aero-viz-link", daemon=True).start()

    def close(self) -> None:
        """Give up the file that is being written, and wait a little until its temporary files are gone."""
        self._progress.cancel()
        if self._writing is not None:
            self._writing.join(_CLOSE_TIMEOUT)

    def _query(self) -> str:
        frame = self.session.frame
        if frame is None:
            return Link.to_moment(self._sources.opening, 0.0, self.session.config).query
        # The server that opens the link knows the facts of the flight as well.
        config = config_without_facts(self.session.config, frame.source)
        return Link.to_moment(self._sources.opening, frame.time, config).query

    def _welcome(self, client: viser.ClientHandle) -> None:
        client.local_storage.set_item(_STORED, "")
        run_script(client, _TAKE_LINK)
        try:
            query = client.local_storage.get_item(_STORED, timeout=_LINK_TIMEOUT)
            link = Link.parse(query or "", type(self.session.config))
        except (RuntimeError, TimeoutError):  # the page was closed, or stores nothing
            return
        except ValueError as error:
            notify(self.page.server, str(error), level="error", client=client)
            return
        if link is not None:
            self._offer(client, link)

    def _offer(self, client: viser.ClientHandle, link: Link) -> None:
        moment = f"{link.opening.spec}, seed {link.opening.seed}, at {link.time:.2f} s"
        changes = (f"{path} = {value}" for path, value in link.config.items())
        self.page.ask(
            client,
            "Open this link?",
            markup.block(f"<b>{markup.text(moment)}</b>", *map(markup.text, changes)),
            yes="Open",
            no="Keep what is shown",
            action=lambda: self._sources.open_link(link, client),
        )

    def _start(self, label: str, client: viser.ClientHandle) -> None:
        if not self._busy.acquire(blocking=False):
            text = "A file is being written; wait until it is done, or cancel it."
            notify(self.page.server, text, level="error", client=client)
            return
        self._writing = threading.Thread(target=self._write, args=(label, client), name="aero-viz-share", daemon=True)
        self._writing.start()

    def _write(self, label: str, client: viser.ClientHandle) -> None:
        opening = self._sources.opening  # another source may be opened while the file is written
        try:
            with self._progress.show(label, client):
                content = self._picture(client) if label == "Picture" else self._content(label, opening)
                self._progress.check()
            name = Path(opening.spec).stem + _KINDS[label][0]
            client.send_file_download(name, content, save_immediately=True)
        except CancelledError as error:
            notify(self.page.server, str(error) or "The session was closed.", client=client)
        except UserError as error:
            notify(self.page.server, str(error), level="error", client=client)
        except Exception as error:
            _log.exception("a file cannot be written")
            notify(self.page.server, f"The file cannot be written: {error}.", level="error", client=client)
        finally:
            self._busy.release()

    def _picture(self, client: viser.ClientHandle) -> bytes:
        """Return a picture of what a visitor sees, from a copy of the visitor's page."""
        with self._copies.copy(client) as view:
            return self._files.picture(self.page.server.link(view_only=True), view)

    def _content(self, label: str, opening: Opening) -> bytes:
        """Return the file of the flight so far: its ticks are planned again, and written at once or afterwards."""
        shown = [name for name, layer in self.page.layers.items() if layer.visible]
        ticks, frame = self._controls.flown().result(), self.session.frame
        if frame is None or not ticks:
            raise UserError("Nothing has been planned yet.")
        command = opening.command(frame.source, config_without_facts(ticks[0][1], frame.source))
        start, end = ticks[0][0].time, ticks[-1][0].time
        is_video = label == "Video"

        def planned(frames: Iterable[Frame]) -> Iterator[Frame]:
            for frame in frames:
                yield frame
                self._progress.report(frame.time - start, end - start, "planned again" if is_video else "written")

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"flight{_KINDS[label][0]}"
            self._files.write(
                planned(self._frames(opening, frame.source, ticks)),
                path,
                command=command,
                layers=shown,
                report=lambda time: self._progress.report(time, end - start, "written"),
            )
            return path.read_bytes()

    def _frames(self, opening: Opening, info: SourceInfo, ticks: Ticks) -> Iterator[Frame]:
        twin = FlightSource.twin(info) if info.world is not None and info.closed_loop else None
        source = twin or open_source(opening.spec, seed=opening.seed)
        yield from repeat(source, ticks, device=self._controls.device, seed=self._controls.seed)
