"""Who may be connected to one of our servers: so many that others still get in, and that files can be opened."""

from __future__ import annotations

import asyncio
import logging
import os
import time
from collections import Counter
from typing import Any

from websockets.asyncio.server import ServerConnection

CLIENTS_MAX = 64
"""Largest number of websockets; one of the page takes about 1 MB."""
BACKLOG = 8
"""Connections that wait to be accepted; asyncio accepts so many before it serves any of them."""
_WAITING_MAX = 64
"""Largest number of connections that are no websocket: requests of files, and whatever else reaches the port."""
_WAITING_PER_ADDRESS = 24
"""Largest number of them from one address; a browser makes six at once."""
_LIMITED_PER_ADDRESS = 16
"""Largest number of websockets from one address without a place of their own."""
_RESERVED = 8
"""One of so many places is kept for those who have a right to one."""
_FILES_KEPT = 64
"""Files that the program can open besides its connections, those included that are about to be refused."""
_REPORT_PERIOD = 60.0
"""Shortest time between two messages of the log about a full server [s]."""

_log = logging.getLogger(__name__)


class Guests:
    """Counts the connections of a server, and ends those that take the place of others. Belongs to one event loop.

    If too many wait, the oldest of the address with the most is ended: whoever floods the port loses connections of
    their own, and others get in.

    Args:
        files: files that the process can still open; None asks the system.
        is_proxied: True if one address may stand for many people.
    """

    def __init__(self, files: int | None = None, *, is_proxied: bool = False) -> None:
        left = max((_files_left() if files is None else files) - _FILES_KEPT, 12)
        self.waiting_max = min(_WAITING_MAX, left // 3)
        """Largest number of connections that are no websocket."""
        self.clients_max = min(CLIENTS_MAX, left - self.waiting_max)
        """Largest number of websockets."""
        self._is_proxied = is_proxied
        self._waiting: dict[GuestConnection, None] = {}
        self._clients: set[GuestConnection] = set()
        self._report_due = 0.0

    def enter(self, connection: GuestConnection) -> None:
        """Count a new connection, and end another one if too many wait."""
        self._waiting[connection] = None
        counts = Counter(one.address for one in self._waiting)
        if counts[connection.address] > min(_WAITING_PER_ADDRESS, self.waiting_max):
            self._end_oldest(connection.address)
        elif len(self._waiting) > self.waiting_max:
            self._end_oldest(counts.most_common(1)[0][0])

    def admit(self, connection: GuestConnection, *, has_right: bool) -> bool:
        """Count a connection as a websocket; return False if there is no place for it.

        Args:
            connection: a connection that has entered.
            has_right: True for one to which the places that are kept are open.
        """
        limited = [one for one in self._clients if not one.has_right]
        if not has_right:
            same = sum(one.address == connection.address for one in limited)
            kept = -(-self.clients_max // _RESERVED)
            if len(limited) >= self.clients_max - kept or (same >= _LIMITED_PER_ADDRESS and not self._is_proxied):
                return False
        if len(self._clients) >= self.clients_max:
            return False
        connection.has_right = has_right
        self._waiting.pop(connection, None)
        self._clients.add(connection)
        return True

    def leave(self, connection: GuestConnection) -> None:
        """Forget a connection that has ended."""
        self._waiting.pop(connection, None)
        self._clients.discard(connection)

    def _end_oldest(self, address: str) -> None:
        oldest = next(one for one in self._waiting if one.address == address)
        del self._waiting[oldest]
        oldest.transport.abort()
        if time.monotonic() > self._report_due:
            self._report_due = time.monotonic() + _REPORT_PERIOD
            _log.warning("%s opens many connections and uses few of them; the oldest ones are closed.", address)


class GuestConnection(ServerConnection):
    """A connection that is counted.

    Args:
        arguments, options: those of `ServerConnection`.
        guests: the connections of the server.
    """

    def __init__(self, *arguments: Any, guests: Guests, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.address = ""
        """Address of the other side, without its port."""
        self.has_right = False
        """True if it may take one of the places that are kept."""
        self._guests = guests

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Count the connection."""
        super().connection_made(transport)
        self.address = str((transport.get_extra_info("peername") or ("",))[0])
        self._guests.enter(self)

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the connection."""
        self._guests.leave(self)
        super().connection_lost(exc)


def report_briefly(loop: asyncio.AbstractEventLoop) -> None:
    """Log in one line, once a minute, that no connection can be accepted; asyncio logs a traceback each time."""
    due = 0.0

    def handle(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        nonlocal due
        if not isinstance(context.get("exception"), OSError) or "accept" not in context.get("message", ""):
            loop.default_exception_handler(context)
        elif time.monotonic() > due:
            due = time.monotonic() + _REPORT_PERIOD
            _log.warning("No further connection is accepted: %s.", context["exception"].strerror)

    loop.set_exception_handler(handle)


def _files_left() -> int:
    """Return how many files this process can still open; many where the system does not say."""
    try:
        import resource

        return resource.getrlimit(resource.RLIMIT_NOFILE)[0] - len(os.listdir("/proc/self/fd"))
    except (ImportError, OSError):
        return 1024
