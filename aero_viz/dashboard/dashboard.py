"""The dashboard: draws the newest frame on the page, at most 30 times per second."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Sequence

import viser

from aero_viz.dashboard.layers import LAYERS, Change, Layer, apply
from aero_viz.dashboard.pace import Pace
from aero_viz.dashboard.panels import Page
from aero_viz.dashboard.panels.layout import build
from aero_viz.dashboard.server import LocalServer, notify
from aero_viz.errors import UserError
from aero_viz.session.broadcast import Steerable
from aero_viz.session.frame import Frame, Notice
from aero_viz.session.sinks import Sink
from aero_viz.session.source import Opener, Source

__all__ = ["Dashboard"]

_PANEL_PERIOD = 0.2


class Dashboard:
    """Shows a session on a web page and lets the page steer it. The session is the caller's: start and close it.

    Args:
        session: what to show; may be running, paused or ticked by hand.
        host: address to listen on. Everyone who reaches it can steer the session: there is no password.
        port: port to listen on; 0 takes any free one.
        open_source: makes a source from a path or a scene's name, and a seed; None hides the choice of the source.
        choices: (label, what `open_source` gets) of the sources on offer.
        seed: what `open_source` gets until the page gives another.

    Raises:
        UserError: the port is taken.
    """

    def __init__(
        self,
        session: Steerable,
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        open_source: Opener | None = None,
        choices: Sequence[tuple[str, str]] = (),
        seed: int = 0,
    ) -> None:
        self.server = LocalServer(host=host, port=port)
        self.layers: dict[str, Layer] = {layer.name: layer(self.server) for layer in LAYERS}
        """The layers by name."""
        self.update_ms: deque[float] = deque(maxlen=300)
        """Time that the last updates took [ms]."""
        self._session = session
        self._source: Source | None = None
        self._pace = Pace()
        self._panels_due = 0.0
        self._panels_late = False
        self._sink: Sink | None = None
        page = Page(self.server, session, self.layers, self.refresh)
        self._camera, self._panels = build(page, open_source=open_source, choices=choices, seed=seed)
        self._sink = session.subscribe(self._show, name="dashboard")
        self._others = [
            session.subscribe_notices(self._notify),
            session.subscribe_playing(lambda _: self.refresh()),
        ]
        self.server.on_client_connect(self._greet)

    @property
    def url(self) -> str:
        """Address of the page."""
        return self.server.url

    @property
    def failures(self) -> int:
        """Number of frames that could not be shown; the log says why."""
        return 0 if self._sink is None else self._sink.failures

    def refresh(self) -> None:
        """Show the newest frame again, or that there is none yet."""
        if self._sink is not None:
            self._panels_due = 0.0
            self._sink.put(self._session.frame)

    def show_only(self, names: Sequence[str] | None) -> None:
        """Show these layers and no other; None shows those that are on by default.

        Raises:
            UserError: there is no such layer; lists them.
        """
        for name in names or ():
            if name not in self.layers:
                raise UserError(f"There is no layer {name!r}; the layers are {', '.join(self.layers)}.")
        for name, layer in self.layers.items():
            layer.visible = layer.on if names is None else name in names
        self.refresh()

    def drain(self, timeout: float = 10.0) -> bool:
        """Wait until the newest frame is sent; False when that takes longer than `timeout` [s]."""
        self.refresh()
        return self._sink is not None and self._sink.drain(timeout)

    def close(self) -> None:
        """Close the page; the session goes on."""
        if self._sink is not None:
            self._session.unsubscribe(self._sink)
        for sink in self._others:
            self._session.unsubscribe(sink)
        for panel in self._panels:
            panel.close()
        self.server.stop()

    def _greet(self, client: viser.ClientHandle) -> None:
        self.refresh()

        @client.camera.on_update
        def _(_: viser.CameraHandle) -> None:
            if self._camera.is_settling(client):
                self.refresh()

    def _show(self, frame: Frame | None) -> None:
        """Runs in the sink's thread: what waits meanwhile is the newest frame, so nothing old is ever shown.

        Does nothing while nobody looks; who connects asks for a refresh.
        """
        frame = frame or self._session.frame  # the first may have come since
        if frame is None:
            apply(change for panel in self._panels for change in panel.wait())
            return
        clients = list(self.server.get_clients().values())
        if not clients:
            apply(self._camera.follow(frame))
            return
        started = time.perf_counter()
        changes = self._changes(frame)
        with contextlib.ExitStack() as stack:
            for sender in (self.server, *clients):
                stack.callback(sender.flush)
                stack.enter_context(sender.atomic())
            apply(changes)
        ended = time.perf_counter()
        self.update_ms.append(1e3 * (ended - started))
        playing = self._session.playing
        if playing and frame.source.closed_loop:
            self._pace.note(frame.rate, self._session.speed / frame.source.period)
        if self._panels_late and not playing:
            # While time stands still no frame follows that would bring the panels up to date.
            later = threading.Timer(_PANEL_PERIOD, self.refresh)
            later.daemon = True
            later.start()
        time.sleep(self._pace.delay(ended))

    def _changes(self, frame: Frame) -> list[Change]:
        """Compute everything before the first message is queued."""
        changes: list[Change] = []
        if frame.source is not self._source:
            self._source = frame.source
            for part in (*self.layers.values(), *self._panels):
                changes += part.enter(frame.source)
        for layer in self.layers.values():
            if layer.visible:
                changes += layer.update(frame)
        changes += self._camera.follow(frame)
        now = time.monotonic()
        self._panels_late = now < self._panels_due
        if not self._panels_late:
            self._panels_due = now + _PANEL_PERIOD
            for panel in self._panels:
                changes += panel.update(frame)
        return changes

    def _notify(self, notice: Notice) -> None:
        notify(self.server, notice.text, level=notice.level)
        self.refresh()
