"""What viser needs before its server can be used: a safe wake-up, and a way to pass options to `websockets`."""

from __future__ import annotations

import asyncio
import contextlib
import threading
import warnings
from collections.abc import Iterator
from typing import Any

import websockets.asyncio.server
from websockets import Request, Response
from websockets.asyncio.server import ServerConnection

warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")  # of a visitor who has just left
_patch_lock = threading.Lock()


class LoopEvent(asyncio.Event):
    """An event that may be set from any thread.

    viser's message buffer sets its event from the thread that sends a message. If that happens just before the event
    loop starts to wait, the event is set while somebody waits for it: it cannot be set again, and no message is sent
    until another client connects. Here it is set on the event loop only.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        super().__init__()
        self._target_loop = loop
        self._is_scheduled = False

    def set(self) -> None:
        """Set the event: at once when called on its loop, otherwise as soon as the loop runs."""
        if asyncio._get_running_loop() is self._target_loop:
            self._is_scheduled = False
            super().set()
        elif not self._is_scheduled:  # one wake-up for all messages of an update
            self._is_scheduled = True
            with contextlib.suppress(RuntimeError):  # the server was stopped
                self._target_loop.call_soon_threadsafe(self.set)


@contextlib.contextmanager
def serving(admit: Any, options: dict[str, Any]) -> Iterator[None]:
    """Start the websocket server of viser, inside the context, with further `options` of `websockets`.

    Args:
        admit: called before viser's own function that answers requests, with the same arguments.
        options: arguments of `websockets.asyncio.server.serve`.
    """
    original = websockets.asyncio.server.serve

    def serve(handler: Any, *arguments: Any, process_request: Any = None, **given: Any) -> Any:
        if not handler.__module__.startswith("viser."):
            return original(handler, *arguments, process_request=process_request, **given)

        async def process(connection: ServerConnection, request: Request) -> Response | None:
            return await admit(connection, request) or process_request(connection, request)

        return original(handler, *arguments, process_request=process, **{**given, **options})

    with _patch_lock:
        websockets.asyncio.server.serve = serve  # type: ignore[assignment,misc]
        try:
            yield
        finally:
            websockets.asyncio.server.serve = original
