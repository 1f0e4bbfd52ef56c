"""The choice of the source."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from pathlib import Path
from typing import Any

import viser

from aero_planner.config import DroneConfig
from aero_viz.dashboard.folders import Folders
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.links import Link, Opening
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.base import TYPING_DELAY, Page, Panel
from aero_viz.dashboard.panels.conditions import ConditionControls
from aero_viz.dashboard.server import notify
from aero_viz.errors import UserError
from aero_viz.flight.known_drone import config_for_next_flight
from aero_viz.reader_process import ReadCancelled, ReaderProcess
from aero_viz.session.base import SessionControls
from aero_viz.session.frame import Frame
from aero_viz.session.source import Conditions, Opener, Source

_log = logging.getLogger(__name__)
_LINK_STEPS = 25
"""Ticks to fly at once on the way to the time of a link; other commands wait for them."""
_PROGRESS_PERIOD = 0.5
"""Time between two updates of the displayed progress [s]."""


class SourcePanel(Panel):
    """Opens scenes and recordings. If one cannot be opened, the page says so and the current source continues.

    A separate process reads the files, one at a time; anybody can cancel it. Reasons that may quote a file are
    written to the terminal only: the page may be seen by people who cannot read the file.

    Args:
        page: page of the panel.
        controls: commands of the session.
        open_source: opens a source by name or path.
        choices: sources on offer, each a label and the argument of `open_source`.
        folders: folders whose files the page may open, besides `choices`.
        seed: first value of the seed.
        opened: argument of `open_source` for the source that is open at first; empty if it is not known.
        conditions: first values of the conditions; None does not offer them.
    """

    def __init__(
        self,
        page: Page,
        controls: SessionControls,
        open_source: Opener,
        choices: Sequence[tuple[str, str]],
        folders: Folders,
        *,
        seed: int,
        opened: str = "",
        conditions: Conditions | None = None,
    ) -> None:
        self._controls = controls
        self._open_source = open_source
        self._folders = folders
        self._first_seed = seed
        self._first_conditions = conditions
        # A dropdown cuts off long entries: it gets the names, and a line below it gets the descriptions.
        split = [(*label.partition(": "), spec) for label, spec in choices]
        self._choices = {name: (description, spec) for name, _, description, spec in split}
        self._offered = frozenset([opened, *(spec for _, spec in choices)])
        """Files that may be opened outside the folders."""
        own = (Path(spec).resolve() for spec in self._offered if Path(spec).exists())
        self._readable = (*folders.paths, *(path if path.is_dir() else path.parent for path in own))
        """Folders in which a reader may open files."""
        self._opened = opened or (next(iter(self._choices.values()))[1] if choices else "")
        self.opening = Opening(self._opened, seed, conditions)
        """Source that is open."""
        self._is_listed = False
        """True while the list shows the open source, or what somebody has chosen since."""
        self._is_chosen = False
        """True if somebody has chosen an entry of the list since the last source began to open."""
        self._reader: ReaderProcess | None = None
        """Reader of the source that is being opened; None if there is none."""
        self._is_read = False
        """True while the session takes over a source that has been read; this takes a moment and cannot be
        cancelled."""
        self._cancellations = 0
        self._closed = False
        self._lock = threading.Lock()
        super().__init__(page)

    def create(self, gui: viser.GuiApi) -> None:
        hint = "Seed of the scene, the LiDAR and all noise. Another seed gives another forest."
        self._seed = gui.add_number("Seed", self._first_seed, min=0, step=1, hint=hint)
        if self._choices:
            self._add_choice(gui)
        self._conditions: ConditionControls | None = None
        if self._first_conditions is not None:
            self._conditions = ConditionControls(gui, self._first_conditions)
            self._conditions.offer(self._opened, count=self._first_conditions.count)
        if self._choices:
            self._add_open(gui)
        hint = "Path of a recording or a world in the folders that the page may open, or the name of a scene."
        with gui.add_form(None) as form:
            path = gui.add_text("Path", "", hint=hint)
        open_path = gui.add_button("Open path", icon=viser.Icon.FOLDER_OPEN, color="gray")
        self._cancel = gui.add_button("Cancel opening", icon=viser.Icon.X, color="red", visible=False)

        @form.on_submit
        async def _(event: viser.GuiEvent) -> None:
            await self._start_opening(lambda: path.value.strip(), event.client)

        @open_path.on_click
        async def _(event: viser.GuiEvent) -> None:
            await self._start_opening(lambda: path.value.strip(), event.client)

        @self._cancel.on_click
        async def _(_: viser.GuiEvent) -> None:
            self.cancel()

    def _add_choice(self, gui: viser.GuiApi) -> None:
        """Add the list of sources, which shows the one that is open until another one is chosen."""
        self._choice = gui.add_dropdown("Scene", tuple(self._choices), hint="Scenes and recordings to open.")
        description = gui.add_html(markup.note(self._choices[self._choice.value][0]))

        @self._choice.on_update
        async def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                self._is_listed = self._is_chosen = True
            text, spec = self._choices[self._choice.value]
            description.content = markup.note(text)
            if self._conditions is not None:
                self._conditions.offer(spec)

    def _add_open(self, gui: viser.GuiApi) -> None:
        """Add the button that opens the chosen source, below all that it uses."""
        hint = "Open the scene with this seed and these conditions; a change of them alone has no effect."
        open_choice = gui.add_button("Open", icon=viser.Icon.PLAYER_EJECT, color="gray", hint=hint)

        @open_choice.on_click
        async def _(event: viser.GuiEvent) -> None:
            await self._start_opening(lambda: self._choices[self._choice.value][1], event.client)

    def update(self, frame: Frame) -> list[Change]:
        """Show a source that was opened as the choice; one that was opened by its path joins the list."""
        if self._is_listed or not self._choices:
            return []
        self._is_listed, spec = True, self._opened
        place = _place(spec)
        name = next((name for name, (_, offered) in self._choices.items() if _place(offered) == place), None)
        if name is None:
            name = spec if Path(spec).name in self._choices else Path(spec).name
            self._choices[name] = (spec, spec)
        return [(self._choice, "options", tuple(self._choices)), (self._choice, "value", name)]

    def cancel(self) -> None:
        """Stop opening a source, and drop the requests that wait."""
        with self._lock:
            self._cancellations += 1
            reader = self._reader
        if reader is not None:
            reader.cancel()

    def close(self) -> None:
        self._closed = True
        self.cancel()

    def reopen(self, seed: int) -> Source:
        """Return the source that is open, opened once more with another seed and the same conditions.

        Raises:
            UserError: it cannot be opened any more.
        """
        conditions = self.opening.conditions
        options: dict[str, Any] = {} if conditions is None else {"conditions": conditions}
        return self._open_source(self._opened, seed=seed, **options)

    async def _start_opening(self, read_spec: Callable[[], str], client: viser.ClientHandle | None) -> None:
        """Open a source on a daemon thread. The program would wait for viser's thread pool at exit."""
        cancellations = self._cancellations
        await asyncio.sleep(TYPING_DELAY)
        spec = read_spec()
        if not spec:
            notify(self.page.server, "Enter the path of a recording or a world first.", level="error", client=client)
            return
        options: dict[str, Any] = {"seed": int(self._seed.value)}
        if self._conditions is not None:
            try:
                options["conditions"] = self._conditions.read(spec)
            except ValueError as error:
                notify(self.page.server, str(error), level="error", client=client)
                return
        while self._is_read:  # its scene may be on the page already: a click on Open then means the next one
            await asyncio.sleep(TYPING_DELAY)
        with self._lock:
            if self._cancellations != cancellations:
                return
            if self._reader is not None:
                notify(self.page.server, "A source is being opened; cancel that first.", level="error", client=client)
                return
            self._reader = ReaderProcess(folders=self._readable)
        self._open_in_thread(self._reader, spec, options, client)

    def open_link(self, link: Link, client: viser.ClientHandle | None) -> None:
        """Open the source of a link, and go to its time with its configuration, in the background."""
        with self._lock:
            if self._reader is not None:
                notify(self.page.server, "A source is being opened; cancel that first.", level="error", client=client)
                return
            self._reader = ReaderProcess(folders=self._readable)
        options: dict[str, Any] = {"seed": link.opening.seed}
        if link.opening.conditions is not None and self._first_conditions is not None:
            options["conditions"] = link.opening.conditions
        self._open_in_thread(self._reader, link.opening.spec, options, client, link)

    def _open_in_thread(self, *arguments: Any) -> None:
        threading.Thread(target=self._open, args=arguments, name="aero-viz-open", daemon=True).start()

    def _open(
        self,
        reader: ReaderProcess,
        spec: str,
        options: dict[str, Any],
        client: viser.ClientHandle | None,
        link: Link | None = None,
    ) -> None:
        """Open a source by name or path and make it the session's; problems are shown to `client`."""
        self._cancel.visible, self._is_chosen = True, False
        try:
            with self._progress_notification(f"Opening {spec} ..", reader, client):
                path = self._find(spec, client)
                source = None if path is None else self._read(reader, path, spec, options, client)
                if path is not None and source is not None and self._use(source, path, seed=options["seed"]):
                    self.opening = Opening(spec, options["seed"], options.get("conditions"))
                    if link is not None:
                        self._go_to(link, reader)
        finally:
            with self._lock:
                self._reader, self._is_read = None, False
            if not self._closed:
                self._cancel.visible = False
                self.page.refresh()

    def _go_to(self, link: Link, reader: ReaderProcess) -> None:
        """Use the configuration of a link from the start on, and fly to its time, or until that is cancelled."""
        self.session.pause()
        self._controls.configure(self.page.config_for_flight(type(self.session.config)().replace(link.config)))
        if link.time <= 0.0:
            return
        self._is_read = False  # the way there may be long, and can be cancelled
        with contextlib.suppress(CancelledError):
            if self.session.seek(link.time).exception() is not None:
                return
            frame = self.session.frame
            while frame is not None and frame.outcome is None and frame.time < link.time - 0.5 * frame.source.period:
                if reader.is_cancelled:
                    return
                ticks = round((link.time - frame.time) / frame.source.period)
                if frame.source.times is not None or self.session.step(min(ticks, _LINK_STEPS)).exception() is not None:
                    return
                frame = self.session.frame

    def _use(self, source: Source, path: str, *, seed: int) -> bool:
        """Make `source` the session's. It plays if the previous source was playing, even if that had ended.

        Returns:
            False if its first tick failed; the previous source then stays.
        """
        self._is_read = True
        frame, was_playing = self.session.frame, self.session.playing
        had_ended = frame is not None and frame.outcome is not None
        self.session.pause()  # a link goes to its time only after its configuration is used

        def as_known(config: DroneConfig) -> DroneConfig:
            """Return a configuration with the facts of the new flight; a recording has none."""
            return config if frame is None else config_for_next_flight(config, before=frame.source, after=source.info)

        with contextlib.suppress(CancelledError):  # the session was closed in the meantime
            # If its first tick fails, the session notifies everyone.
            is_used = self._controls.set_source(source, seed=seed, convert=as_known).exception() is None
            if is_used:
                self._opened, self._is_listed = path, self._is_chosen
            if was_playing or (is_used and had_ended):
                self.session.play()
            return is_used
        return False

    def _find(self, spec: str, client: viser.ClientHandle | None) -> str | None:
        """Return the argument of the opener for a name or a path; None if the page may not open it."""
        try:
            return spec if spec in self._offered else str(self._folders.find(spec))
        except UserError as error:
            notify(self.page.server, str(error), level="error", client=client)
            return None

    def _read(
        self, reader: ReaderProcess, path: str, spec: str, options: dict[str, Any], client: viser.ClientHandle | None
    ) -> Source | None:
        """Return the source, or None if it cannot be opened; messages name it as the user did, by `spec`."""
        try:
            source = self._open_source(path, read=reader, **options)
            if not reader.is_cancelled:
                return source
            source.close()
            raise ReadCancelled
        except ReadCancelled:
            notify(self.page.server, f"{spec} was not opened, since that was cancelled.", client=client)
        except Exception as error:
            expected = isinstance(error, (UserError, ValueError, OSError))
            _log.error("%s cannot be opened: %s", spec, error, exc_info=None if expected else error)
            text = f"{spec} cannot be opened; the terminal shows why."
            notify(self.page.server, text, level="error", client=client)
        return None

    @contextlib.contextmanager
    def _progress_notification(
        self, text: str, reader: ReaderProcess, client: viser.ClientHandle | None
    ) -> Iterator[None]:
        """Show `text` with a spinner and the progress to `client`, or to everyone, during the context."""
        clients = [other for other in self.page.server.get_clients().values() if client in (None, other)]
        shown = [c.add_notification("AERO-Viz", text, loading=True, with_close_button=False) for c in clients]
        is_over = threading.Event()

        def show_progress() -> None:
            while not is_over.wait(_PROGRESS_PERIOD):
                for notification in shown:
                    notification.body = f"{text} {reader.progress}"

        thread = threading.Thread(target=show_progress, name="aero-viz-open-progress", daemon=True)
        thread.start()
        try:
            yield
        finally:
            is_over.set()
            thread.join()
            for notification in shown:
                notification.remove()


def _place(spec: str) -> Path:
    """Return the canonical path of a file; any other name is returned unchanged."""
    return Path(spec).expanduser().resolve() if Path(spec).expanduser().exists() else Path(spec)
