"""The dashboard: draws the newest frame on the page, at most 30 times per second."""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from aero_planner.mailbox import Mailbox
from aero_viz.dashboard.folders import Folders
from aero_viz.dashboard.history import FlightHistory
from aero_viz.dashboard.layers import (
    LAYERS,
    Change,
    ColorKey,
    ColorScale,
    Layer,
    apply,
    known_names,
    legend_entries,
)
from aero_viz.dashboard.panels import Page, Panel
from aero_viz.dashboard.panels.camera import CameraPanel
from aero_viz.dashboard.panels.layout import Offer, build
from aero_viz.dashboard.panels.live import LiveOffer
from aero_viz.dashboard.panels.share import Files
from aero_viz.dashboard.server import LocalServer, notify
from aero_viz.dashboard.update_rate import UpdateRateLimiter
from aero_viz.session.base import BaseSession
from aero_viz.session.comparison import ComparisonEvent
from aero_viz.session.frame import Frame, Notice
from aero_viz.session.source import Conditions, Opener, SourceInfo
from aero_viz.study_view import Study

_PANEL_PERIOD = 0.2
"""Shortest time between two updates of the panels [s]."""


class Dashboard:
    """Shows a session on a web page, and controls it if it has controls. The caller starts and closes the session.

    Args:
        session: session to show; may be running, paused or ticked by hand.
        host: address to listen on. If other machines can reach it, a link with a token is required.
        port: port to listen on; 0 takes any free one.
        open_source: opens a source by path or scene name and seed; None hides the choice of the source.
        choices: sources on offer, each a label and the argument of `open_source`.
        seed: first value of the seed that the page passes to `open_source`.
        opened: argument of `open_source` for the session's source; the page may open it again.
        conditions: first values of the conditions that the page passes to `open_source`; None does not offer them.
        layers: layers to draw, in the order of the page; None draws all of `LAYERS`.
        panels: show the panels; without them the page loads in half the time.
        folders: folders whose files the page may open, besides `choices`.
        allowed_hosts: names under which browsers reach the page besides `host`, such as that of a proxy.
        embedders: origins of foreign pages that may show the page in a frame, such as that of a notebook.
        history: keeps what the curves show; None keeps the ticks of the session, the newest 30 000.
        files: writes the flight to files for visitors, such as `aero_viz.dashboard.share.FlightFiles()`; None does not.
        study: study of `aero-viz tune` to show, as a tab.
        live: what the tab of a live stream offers; None for another session.
        server: web server to use; None starts one with `host`, `port` and `allowed_hosts`, which are ignored otherwise.
        drawn: layers that the server shows already, see `show_first_picture`.

    Raises:
        UserError: the port is taken, or the host is not an address of this machine.
    """

    def __init__(
        self,
        session: BaseSession,
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        open_source: Opener | None = None,
        choices: Sequence[tuple[str, str]] = (),
        seed: int = 0,
        opened: str = "",
        conditions: Conditions | None = None,
        layers: Sequence[type[Layer]] | None = None,
        panels: bool = True,
        folders: Sequence[str | Path] = (),
        allowed_hosts: Sequence[str] = (),
        embedders: Sequence[str] = (),
        history: FlightHistory | None = None,
        files: Files | None = None,
        study: Study | None = None,
        live: LiveOffer | None = None,
        server: LocalServer | None = None,
        drawn: Sequence[Layer] = (),
    ) -> None:
        self.server = server or LocalServer(host=host, port=port, allowed_hosts=allowed_hosts, embedders=embedders)
        """The web server."""
        self.server.catch_up = session.catch_up
        self.server.number_fields.on_waiting = self.refresh
        offered = dict(LAYERS) if layers is None else {kind.name: kind for kind in layers}
        kinds = [name for name, kind in offered.items() if session.controls is not None or not kind.needs_samples]
        self.layers: dict[str, Layer]
        """The layers by name."""
        self.panels: list[Panel]
        """All panels."""
        self.source: SourceInfo | None = None
        """Source of the last frame that was shown."""
        self.history = FlightHistory() if history is None else history
        """Every tick of the source so far."""
        self.update_ms: deque[float] = deque(maxlen=300)
        """Durations of the last updates [ms]."""
        self.eye: NDArray[np.float64] | None = None
        """Position from which a picture will be rendered [m], shape [3]; None if only visitors look."""
        self.director: Callable[[Frame], tuple[NDArray[np.float64], NDArray[np.float64]]] | None = None
        """Returns position and look-at point of every camera [m]; None leaves the cameras to the visitors."""
        self._session = session
        self._limiter = UpdateRateLimiter()
        self._panels_due = 0.0
        self._panels_outdated = False
        self._sink: Mailbox[Any] | None = None
        known = {type(layer): layer for layer in drawn}
        with self.server.atomic():  # a page that is already open builds the panels once
            made = [known.get(offered[name]) or self._make_layer(name, offered[name]) for name in kinds]
            self.layers = {layer.name: layer for layer in made if layer is not None}
            self._page = Page(self.server, session, self.layers, self.history, self.refresh)
            if panels:
                offer = Offer(open_source, choices, seed, Folders(folders), opened, conditions, files, study, live)
                self._camera, self.panels = build(self._page, offer)
            else:
                self._camera = CameraPanel(self._page)
                self.panels = [self._camera]
        if panels and session.controls is not None:
            session.controls.judge_candidates()
        self._sink = session.subscribe(self._show_newest, name="dashboard")
        self._event_sinks: list[Mailbox[Any]] = [
            session.subscribe(self.history.add, every=True, name="history"),
            session.subscribe_notices(self._notify),
            session.subscribe_playing(lambda _: self.refresh()),
        ]
        self._comparison = None if session.controls is None else session.controls.comparison
        if self._comparison is not None:
            self._comparison_sink = self._comparison.subscribe(self._follow_comparison, name="comparison")
        self.server.on_client_connect(self._welcome)

    def _make_layer(self, name: str, kind: type[Layer]) -> Layer | None:
        """Return a new layer, None for a brought one that cannot be made."""
        return kind(self.server) if LAYERS.get(name) is not kind else LAYERS.made(name, lambda kind: kind(self.server))

    @property
    def url(self) -> str:
        """Link to the page, which controls the session."""
        return self.server.link()

    @property
    def failures(self) -> int:
        """Number of frames that could not be shown; the log has the reasons."""
        return 0 if self._sink is None else self._sink.failures

    def refresh(self) -> None:
        """Show the newest frame again, or a message if there is none yet."""
        if self._sink is not None:
            self._panels_due = 0.0
            self._sink.put(None)

    def show_only(self, names: Sequence[str] | None) -> None:
        """Show these layers and hide all others; None shows those that are on by default.

        Raises:
            UserError: there is no such layer; lists them.
        """
        shown = None if names is None else known_names(names, self.layers)
        for name, layer in self.layers.items():
            layer.visible = layer.on_by_default if shown is None else name in shown
        self._page.update_samples()
        self.refresh()

    def legend(self) -> list[ColorKey | ColorScale]:
        """Return the meaning of the colours of the visible layers."""
        frame = self._session.frame
        return [] if frame is None else legend_entries(self.layers.values(), frame)

    def drain(self, timeout: float = 10.0) -> bool:
        """Wait until the newest frame is sent; return False if that takes longer than `timeout` [s]."""
        self.refresh()
        return self._sink is not None and self._sink.drain(timeout)

    def changes(self, frame: Frame) -> list[Change]:
        """Return the changes that show `frame`."""
        changes: list[Change] = []
        if frame.source is not self.source:
            self.source = frame.source
            for part in (*self.layers.values(), *self.panels):
                changes += part.on_new_source(frame.source)
        if self.director is not None:
            changes += self._directed(frame)
        else:
            changes += self._camera.follow(frame)
        eyes = self._camera.eyes if self.eye is None else [self.eye]
        for layer in self.layers.values():
            if layer.visible:
                layer.eyes, layer.history = eyes, self.history
            changes += layer.show(frame)
        now = time.monotonic()
        self._panels_outdated = now < self._panels_due
        if not self._panels_outdated:
            self._panels_due = now + _PANEL_PERIOD
            for panel in self.panels:
                changes += panel.update(frame)
        return changes

    def _directed(self, frame: Frame) -> list[Change]:
        """Return the changes that move the camera of every visitor to where the director wants it."""
        assert self.director is not None
        eye, target = self.director(frame)
        self._camera.eyes = [eye]
        cameras = [client.camera for client in self.server.get_clients().values()]
        return [change for camera in cameras for change in ((camera, "position", eye), (camera, "look_at", target))]

    def close(self) -> None:
        """Close the page. The session continues."""
        for sink in (self._sink, *self._event_sinks):
            if sink is not None:
                self._session.unsubscribe(sink)
        if self._comparison is not None:
            self._comparison.unsubscribe(self._comparison_sink)
        for panel in self.panels:
            panel.close()
        self.server.stop()

    def _welcome(self, client: viser.ClientHandle) -> None:
        for part in (*self.layers.values(), *self.panels):
            part.welcome(client)
        self.refresh()

        @client.camera.on_update
        def _(_: viser.CameraHandle) -> None:
            if self._camera.is_settling(client):
                self.refresh()
            elif self._sink is not None and not self._session.playing:
                self._sink.put(None)  # other obstacles may hide the drone now

    def _show_newest(self, _: object) -> None:
        """Send the session's newest frame, on the sink's thread.

        Without clients only the camera follows: a client that connects requests a refresh.
        """
        frame, present = self._session.frame, self.server.get_clients()
        for part in (*self.panels, *self.layers.values()):
            part.forget_all_but(present)
        if frame is None:
            apply(change for panel in self.panels for change in panel.update_without_frame())
            return
        clients = list(present.values())
        if not clients:
            apply(self._camera.follow(frame))
            return
        started, computed_at = time.perf_counter(), time.time()
        changes = self.changes(frame)  # all of them, before the first message is queued
        with contextlib.ExitStack() as stack:
            for sender in (self.server, *clients):
                stack.callback(sender.flush)
                stack.enter_context(sender.atomic())
            apply(self.server.number_fields.admit(changes), computed_at=computed_at)
        ended = time.perf_counter()
        self.update_ms.append(1e3 * (ended - started))
        playing = self._session.playing
        if playing and frame.source.closed_loop:
            self._limiter.adapt(frame.rate, self._session.speed / frame.source.period)
        if self._panels_outdated and not playing:
            self._page.refresh_after(_PANEL_PERIOD)
        time.sleep(self._limiter.delay(ended))

    def _follow_comparison(self, event: ComparisonEvent) -> None:
        self.history.compare(event)
        if event.kind != "flown" or event.frame is None or event.frame.outcome is not None:
            self.refresh()
        elif self._sink is not None:
            self._sink.put(None)

    def _notify(self, notice: Notice) -> None:
        notify(self.server, notice.text, level=notice.level)
        self.refresh()
