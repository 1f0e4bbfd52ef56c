"""A server for Foxglove and Lichtblick: the messages of the flight log, live over a WebSocket."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

from aero_planner import VehicleState
from aero_planner.mailbox import Mailbox
from aero_planner.onboard.ros_messages import DEFINITIONS, Encoded
from aero_viz.errors import UserError
from aero_viz.logs.flight_messages import FlightMessages
from aero_viz.session.base import BaseSession
from aero_viz.session.frame import Frame

_WAITING = 1024  # ticks that wait for the encoder; a headless flight is faster than real time
_CLOSE_TIMEOUT = 2.0  # [s] for the last messages


class FoxgloveServer:
    """Sends frames to all clients. As soon as a client subscribes to a topic, its last message is sent again.

    All subscribers get it: the SDK does not say which of its sinks belongs to a client.

    Clients can only watch: the server offers no service, no parameter and no channel to publish on.

    Args:
        host: address to listen on.
        port: port to listen on; 0 takes a free one.

    Raises:
        UserError: foxglove-sdk is not installed, or the port cannot be opened.
    """

    def __init__(self, host: str, port: int) -> None:
        try:
            import foxglove
        except ImportError as error:
            text = (
                f"foxglove-sdk is not installed ({error}): pip install 'aero-viz[foxglove]', or leave --foxglove out."
            )
            raise UserError(text) from error
        self._foxglove, self._context = foxglove, foxglove.Context()
        self._messages = FlightMessages()
        self._channels: dict[str, Any] = {}
        self._last: dict[str, tuple[bytes, int]] = {}
        try:
            self._server = foxglove.start_server(
                name="AERO-Viz", host=host, port=port, context=self._context, server_listener=_listener(self._send_last)
            )
        except (RuntimeError, OverflowError) as error:
            reason = str(error).removeprefix("FoxgloveError: ")
            raise UserError(f"--foxglove cannot listen on port {port} of {host}: {reason}.") from error
        self.url = f"ws://{host}:{self._server.port}"
        """Address for the clients."""

    def write(self, frame: Frame) -> None:
        """Send a frame."""
        self._send(self._messages.encode(frame))

    def write_pose(self, time: float, state: VehicleState) -> None:
        """Send the pose of the drone between two frames; see `FlightMessages.encode_pose`."""
        self._send(self._messages.encode_pose(time, state))

    def close(self) -> None:
        """Disconnect all clients."""
        self._server.stop()

    def _send(self, messages: list[tuple[Encoded, int]]) -> None:
        for message, stamp in messages:
            self._last[message.topic] = (message.data, stamp)
            if message.topic not in self._channels:
                data = DEFINITIONS[message.kind].encode()
                schema = self._foxglove.Schema(name=message.kind, encoding="ros2msg", data=data)
                self._channels[message.topic] = self._foxglove.Channel(
                    message.topic, schema=schema, message_encoding="cdr", context=self._context
                )
            self._channels[message.topic].log(message.data, log_time=stamp)

    def _send_last(self, topic: str) -> None:
        """Send the last message of a topic. Runs on a thread of the server."""
        data, stamp = self._last[topic]
        if topic in self._channels:  # or else the first message follows at once
            self._channels[topic].log(data, log_time=stamp)


def _listener(subscribed: Callable[[str], None]) -> Any:
    """Return a listener of the server that calls a function with each topic that a client subscribes to."""
    from foxglove.websocket import ServerListener

    class Listener(ServerListener):
        def on_subscribe(self, client: Any, channel: Any) -> None:
            subscribed(channel.topic)

    return Listener()


@contextlib.contextmanager
def serve_foxglove(session: BaseSession, host: str, port: int) -> Iterator[FoxgloveServer]:
    """Serve every frame of a session while the context is open. The engine never waits for the clients.

    Raises:
        UserError: see `FoxgloveServer`.
    """
    with contextlib.closing(FoxgloveServer(host, port)) as server:
        sink = session.subscribe(server.write, every=True, name="foxglove")
        try:
            yield server
        finally:
            session.unsubscribe(sink, timeout=_CLOSE_TIMEOUT)
            sink.close(timeout=None)


class _Recorder:
    """A recorder of `aero_viz.flight.fly` that serves on its own thread, and hands everything to another recorder, too.

    Args:
        server: the server.
        log: another recorder, or None.
    """

    def __init__(self, server: FoxgloveServer, log: Any) -> None:
        self._server, self._log = server, log
        self.calls: Mailbox[Callable[[], None]] = Mailbox(
            lambda call: call(), capacity=_WAITING, name="aero-viz-foxglove"
        )

    def write(self, frame: Frame) -> None:
        """Take the frame of a plan."""
        self.calls.put(lambda: self._server.write(frame))
        if self._log is not None:
            self._log.write(frame)

    def write_pose(self, time: float, state: VehicleState) -> None:
        """Take the true state at a time [s]."""
        self.calls.put(lambda: self._server.write_pose(time, state))
        if self._log is not None:
            self._log.write_pose(time, state)


@contextlib.contextmanager
def foxglove_recorder(
    host: str,
    port: int,
    *,
    log: contextlib.AbstractContextManager[Any] | None = None,
    announce: Callable[[str], None] = lambda url: None,
) -> Iterator[_Recorder]:
    """Open a recorder of `aero_viz.flight.fly` that serves the flight.

    Args:
        host, port: see `FoxgloveServer`.
        log: another recorder, which gets the flight, too; None without.
        announce: called with the address for the clients.

    Raises:
        UserError: see `FoxgloveServer`.
    """
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(contextlib.closing(FoxgloveServer(host, port)))
        announce(server.url)
        recorder = _Recorder(server, None if log is None else stack.enter_context(log))
        stack.callback(recorder.calls.finish, _CLOSE_TIMEOUT)
        yield recorder
