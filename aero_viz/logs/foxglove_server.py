"""A server for Foxglove and Lichtblick: the messages of the flight log, live over a WebSocket."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import functools
import logging
import secrets
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

from websockets import Request, Response, Subprotocol
from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed

from aero_planner import VehicleState
from aero_planner.onboard.ros_messages import Encoded
from aero_viz.errors import UserError
from aero_viz.guests import BACKLOG, GuestConnection, Guests, report_briefly
from aero_viz.logs.flight_messages import FlightMessages
from aero_viz.logs.foxglove_client import Channel, FoxgloveClient
from aero_viz.session.base import BaseSession
from aero_viz.session.frame import Frame
from aero_viz.web_access import Access, local_address, quiet_logger

if TYPE_CHECKING:
    from aero_viz.flight.single import FlightRecorders

_REQUEST_MAX = 1 << 16  # [bytes]
_REPORTS_MAX = 8
_HINTS = {
    "Host": " If it is the name of a proxy or of this machine, add --host or --allow-host.",
    "Origin": " If it is yours, add --foxglove-origin and its origin.",
}
"""What to do about a refused client, by the header that decided."""
_SILENCE_MAX = 60.0  # [s] until a slow client answers
_SUBPROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")
_log = logging.getLogger(__name__)


FOXGLOVE_ORIGINS = ("https://app.foxglove.dev", "https://lichtblick-suite.github.io", "file://")
"""Origins of the pages that may read the flight: Foxglove, Lichtblick, and applications for the desktop."""


class FoxgloveServer:
    """Sends frames to all clients. As soon as a client subscribes to a topic, it gets its last message.

    Clients can only watch: the server offers no service, no parameter and no channel to publish on. It answers
    programs, and the pages of Foxglove and Lichtblick; any other page in a browser gets nothing.

    Args:
        host: address to listen on.
        port: port to listen on; 0 takes a free one.
        allowed_hosts: further names under which clients reach the server, such as that of a proxy.
        allowed_origins: origins of further pages that may read the flight.

    Raises:
        UserError: the port cannot be opened, or an argument is not a name or an origin.
    """

    def __init__(
        self, host: str, port: int, *, allowed_hosts: Sequence[str] = (), allowed_origins: Sequence[str] = ()
    ) -> None:
        self._access = Access(host, allowed_hosts, (*FOXGLOVE_ORIGINS, *allowed_origins))
        self._messages = FlightMessages()
        self._channels: dict[int, Channel] = {}
        self._topics: dict[str, Channel] = {}
        self._clients: set[FoxgloveClient] = set()
        self._refusals: set[str] = set()
        self._session = secrets.token_hex(8)
        self._guests = Guests(is_proxied=bool(allowed_hosts))
        self._loop = asyncio.new_event_loop()
        report_briefly(self._loop)
        self._thread = threading.Thread(target=self._loop.run_forever, name="aero-viz-foxglove-server", daemon=True)
        self._thread.start()
        try:
            self._server = asyncio.run_coroutine_threadsafe(self._open(host, port), self._loop).result()
        except (OSError, OverflowError) as error:
            self._stop_loop()
            reason = getattr(error, "strerror", None) or error
            if getattr(error, "errno", None) == errno.EADDRINUSE:
                reason = "it is in use; give another one, such as --foxglove 8766"
            raise UserError(f"--foxglove cannot listen on port {port} of {host}: {reason}.") from error
        self.url = f"ws://{local_address(host, next(iter(self._server.sockets)).getsockname()[1])}"
        """Address for the clients."""

    def write(self, frame: Frame) -> None:
        """Send a frame."""
        self._send(self._messages.encode(frame))

    def write_pose(self, time: float, state: VehicleState) -> None:
        """Send the pose of the drone between two frames; see `FlightMessages.encode_pose`."""
        self._send(self._messages.encode_pose(time, state))

    def is_watched(self) -> bool:
        """Return True if a client subscribes to a topic."""
        return any(client.is_watching for client in tuple(self._clients))

    def close(self) -> None:
        """Disconnect all clients."""
        asyncio.run_coroutine_threadsafe(self._close(), self._loop).result()
        self._stop_loop()

    def _send(self, messages: list[tuple[Encoded, int]]) -> None:
        with contextlib.suppress(RuntimeError):  # the server was closed
            self._loop.call_soon_threadsafe(self._publish, messages)

    async def _open(self, host: str, port: int) -> Server:
        return await serve(
            self._serve,
            host,
            port,
            subprotocols=[Subprotocol(name) for name in _SUBPROTOCOLS],
            process_request=self._admit,
            compression=None,
            create_connection=functools.partial(GuestConnection, guests=self._guests),  # type: ignore[arg-type]
            backlog=BACKLOG,
            ping_timeout=_SILENCE_MAX,
            max_size=_REQUEST_MAX,
            logger=quiet_logger(__name__),
        )

    async def _close(self) -> None:
        self._server.close()
        await self._server.wait_closed()

    def _stop_loop(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def _admit(self, connection: ServerConnection, request: Request) -> Response | None:
        refusal = self._access.refusal(request.headers)
        if refusal is None:
            assert isinstance(connection, GuestConnection)
            if "Upgrade" not in request.headers or self._guests.admit(connection, has_right=False):
                return None
            return connection.respond(503, "Too many clients.\n")
        if refusal.reason not in self._refusals and len(self._refusals) < _REPORTS_MAX:
            self._refusals.add(refusal.reason)
            _log.warning("--foxglove refused a client. %s%s", refusal.reason, _HINTS.get(refusal.header, ""))
        return connection.respond(403, f"{refusal.reason}\n")

    async def _serve(self, connection: ServerConnection) -> None:
        client = FoxgloveClient(connection, self._channels, self._session)
        self._clients.add(client)
        try:
            with contextlib.suppress(ConnectionClosed):
                await client.run()
        finally:
            self._clients.discard(client)

    def _publish(self, messages: list[tuple[Encoded, int]]) -> None:
        for message, stamp in messages:
            channel = self._topics.get(message.topic)
            if channel is None:
                channel = Channel(len(self._topics) + 1, message.topic, message.kind, (message.data, stamp))
                self._topics[message.topic] = self._channels[channel.number] = channel
                for client in self._clients:
                    client.advertise([channel])
            channel.last = (message.data, stamp)
            for client in self._clients:
                client.publish(channel)


@contextlib.contextmanager
def serve_foxglove(session: BaseSession, host: str, port: int, **options: Sequence[str]) -> Iterator[FoxgloveServer]:
    """Serve every frame of a session while the context is open. The engine never waits for the clients.

    Args:
        session: the session.
        host, port, options: see `FoxgloveServer`.

    Raises:
        UserError: see `FoxgloveServer`.
    """
    with (
        contextlib.closing(FoxgloveServer(host, port, **options)) as server,
        session.every_frame(server.write, name="foxglove"),
    ):
        yield server


@contextlib.contextmanager
def foxglove_recorder(
    host: str,
    port: int,
    *,
    log: contextlib.AbstractContextManager[Any] | None = None,
    announce: Callable[[str], None] = lambda url: None,
    **options: Sequence[str],
) -> Iterator[FlightRecorders]:
    """Open a recorder of `aero_viz.flight.fly` that serves the flight.

    Args:
        host, port, options: see `FoxgloveServer`.
        log: another recorder, which gets the flight, too; None without.
        announce: called with the address for the clients.

    Raises:
        UserError: see `FoxgloveServer`.
    """
    from aero_viz.flight.single import FlightRecorders  # loads the simulator, which a viewer of a drone does not need

    with contextlib.ExitStack() as stack:
        server = stack.enter_context(contextlib.closing(FoxgloveServer(host, port, **options)))
        announce(server.url)
        files = [] if log is None else [stack.enter_context(log)]
        yield FlightRecorders(server, *files)
