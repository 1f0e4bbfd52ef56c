"""Code that all commands with a page share: flags, the address on the terminal, and shutdown by a signal."""

from __future__ import annotations

import contextlib
import dataclasses
import signal
import threading
import webbrowser
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from aero_planner.plain_text import say
from aero_planner.termination import leave_terminal
from aero_viz.cli.flags import FoxgloveFlag, OptionalText
from aero_viz.errors import UserError

if TYPE_CHECKING:
    from aero_viz.dashboard import Dashboard, LocalServer
    from aero_viz.evaluation.tune import StoredStudy
    from aero_viz.session import Session
    from aero_viz.session.base import BaseSession

_FOXGLOVE_PORT = 8765
"""Foxglove's own default."""


WATCHING = ("host", "port", "open", "paused", "allow_host", "embed", "foxglove", "foxglove_origin", "ros_out")
"""Flags of a page that opens no files."""


@dataclass(frozen=True)
class PageFlags:
    """The page."""

    host: str = "127.0.0.1"
    """Address to listen on. Beyond 127.0.0.1, the page requires one of two links, which the terminal shows."""
    port: int = 8080
    """Port to listen on."""
    open: bool = False
    """Open the page in the default browser."""
    paused: bool = False
    """Start paused, until somebody presses play."""
    folder: Annotated[tuple[Path, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="DIR")] = ()
    """Folder whose files the page may open, besides that of the first file and our own; may be repeated."""
    allow_host: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NAME")] = ()
    """Further name under which browsers reach the page, such as that of a proxy; may be repeated."""
    embed: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="ORIGIN")] = ()
    """Origin of another web page that may show this one in a frame, such as http://localhost:8888; may be repeated."""
    foxglove: FoxgloveFlag = None
    """Serve the topics of the flight log live on --host, by default on port 8765, for Foxglove and Lichtblick."""
    foxglove_origin: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="ORIGIN")] = ()
    """Origin of another web page that may read the flight there, such as http://localhost:8080; may be repeated."""
    ros_out: bool = False
    """Publish path, candidates, cells, points, status and command in ROS 2, and offer the parameters as a node's."""

    def check(self) -> None:
        """Check the flags for Foxglove and ROS 2 before anything starts.

        Raises:
            UserError: as for `foxglove_port`, or there is no ROS 2.
        """
        _ = self.foxglove_port
        if self.ros_out:
            from aero_viz.ros.graph import import_rclpy

            import_rclpy()

    @property
    def foxglove_port(self) -> int | None:
        """The port for Foxglove; None if it is not served.

        Raises:
            UserError: more than one port was given, a number that is not a port, or an origin without a port.
        """
        if self.foxglove is None:
            if self.foxglove_origin:
                raise UserError("--foxglove-origin says who may use --foxglove; add that flag, too.")
            return None
        port, *rest = self.foxglove or (_FOXGLOVE_PORT,)
        if rest or not 0 <= port < 1 << 16:
            raise UserError(f"--foxglove takes one port from 0 to 65535, not {' '.join(map(str, self.foxglove))}.")
        return port

    def refuse(self, *, besides: Collection[str] = (), advice: str) -> None:
        """Refuse flags that a command would ignore.

        Args:
            besides: names of the flags that it uses.
            advice: what to do, for the error.

        Raises:
            UserError: another flag was set.
        """
        for flag in dataclasses.fields(self):
            if flag.name not in besides and getattr(self, flag.name) != flag.default:
                raise UserError(f"--{flag.name.replace('_', '-')} has no effect here; {advice}.")

    @property
    def server_options(self) -> dict[str, Any]:
        """Arguments of `LocalServer`, or of a dashboard with its own."""
        return {"host": self.host, "port": self.port, "allowed_hosts": self.allow_host, "embedders": self.embed}

    @property
    def foxglove_options(self) -> dict[str, tuple[str, ...]]:
        """Arguments of `FoxgloveServer`."""
        return {"allowed_hosts": self.allow_host, "allowed_origins": self.foxglove_origin}


@dataclass(frozen=True)
class StudyFlags:
    """A study of `aero-viz tune`, as a tab of the page."""

    study: OptionalText = None
    """Name of a study, whose candidates can be compared with the present configuration."""
    storage: str = "sqlite:///results/tune.db"
    """Database of the study, as a URL that Optuna understands."""

    def open(self) -> StoredStudy | None:
        """Return the study, or None if none was named.

        Raises:
            UserError: there is no such study, or it cannot be read.
        """
        if self.study is None:
            return None
        from aero_viz.evaluation.tune import StoredStudy

        return StoredStudy(self.storage, self.study)


def shutdown_event() -> threading.Event:
    """Return an event that is set by Ctrl-C, SIGTERM or SIGHUP, so that the caller can close everything in order.

    A second signal ends the program at once.
    """
    event = threading.Event()
    signals = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # nohup ignores it
        signals.append(signal.SIGHUP)

    def set_event(received: int, _: object) -> None:
        for number in signals:
            signal.signal(number, signal.SIG_DFL)
        if received == signal.SIGHUP:
            leave_terminal()
        event.set()

    for number in signals:
        signal.signal(number, set_event)
    return event


def wait_for(event: threading.Event, meanwhile: Callable[[], object] = lambda: None) -> None:
    """Wait until the event is set, and call `meanwhile` twice a second.

    Python handles a signal when the main thread runs again, which may be never if the signal arrives just before a wait
    without a timeout.
    """
    while not event.wait(0.5):
        meanwhile()


def serve_others(stack: contextlib.ExitStack, session: BaseSession, page_flags: PageFlags) -> Callable[[], bool]:
    """Serve the session for Foxglove and publish it in ROS 2 until the stack closes, as the flags say.

    Returns:
        A function that returns True if one of them has a subscriber.
    """
    watched: list[Callable[[], bool]] = []
    port = page_flags.foxglove_port
    if port is not None:
        from aero_viz.logs import serve_foxglove as serve

        server = stack.enter_context(serve(session, page_flags.host, port, **page_flags.foxglove_options))
        announce_foxglove(server.url)
        watched.append(server.is_watched)
    if page_flags.ros_out:
        from aero_viz.ros.publishing import publish_session

        watched.append(stack.enter_context(publish_session(session)).is_watched)
    return lambda: any(is_watched() for is_watched in watched)


def announce_foxglove(url: str) -> None:
    """Print the address for Foxglove."""
    say(f"Foxglove: {url} (Open connection, Foxglove WebSocket)", flush=True)


def announce(subject: str, server: LocalServer, page_flags: PageFlags) -> None:
    """Print the address of the page and who can reach it, and open it if that is asked for."""
    say(f"AERO-Viz shows {subject} at {server.link()} (press Ctrl-C to stop)", flush=True)
    if not server.is_private:
        for address in server.addresses:
            say(f"  to control it from another machine: {server.link(address=address)}", flush=True)
            say(f"  to watch it from another machine: {server.link(address=address, view_only=True)}", flush=True)
        say("Whoever has a link sees everything. Connections are not encrypted, except behind a proxy.", flush=True)
    if page_flags.open:
        webbrowser.open(server.link())


def play_when_drawn(session: Session, dashboard: Dashboard) -> Callable[[], None]:
    """Start playback when the first page shows everything, so that nobody misses the start.

    A visitor who has begun to play or to step meanwhile goes on from there.

    Returns:
        A function that starts playback now, unless a page has been opened.
    """
    from aero_viz.dashboard.viser_private import wait_until_drawn

    is_first = threading.Semaphore()

    def tick() -> int | None:
        return None if session.frame is None else session.frame.index

    def start_playback(client: Any) -> None:
        if is_first.acquire(blocking=False):
            first = tick()
            dashboard.drain()
            wait_until_drawn(client)
            if tick() == first:
                session.play()

    def start_without_page() -> None:
        if is_first.acquire(blocking=False):
            session.play()

    dashboard.server.on_client_connect(start_playback)
    return start_without_page
