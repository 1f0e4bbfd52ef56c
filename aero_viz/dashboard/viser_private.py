"""All that the page uses of viser's private parts, of its messages, and of how it starts its server.

These parts may change in any version of viser: tests/dashboard/test_viser_private.py names each of them and fails with
another version. Nothing else in this project touches them.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import viser
import websockets.asyncio.server
from viser import _messages
from websockets import Request, Response
from websockets.asyncio.server import ServerConnection

warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")  # of a visitor who has just left
_patch_lock = threading.Lock()
_DRAWN_MAX = 6.0
"""Longest wait for a picture [s]. The page of a visitor who looks at another tab may draw nothing."""
_PICTURES = 3
"""Pictures that a page draws until one shows what was sent: messages wait for the next one, nodes for another."""


def inputs(gui: viser.GuiApi) -> Mapping[str, Any]:
    """Return the controls of a page or of one visitor, by the identifier in their messages."""
    return gui._gui_input_handle_from_uuid


def containers(gui: viser.GuiApi) -> Mapping[str, Any]:
    """Return the forms, folders and tabs of a page or of one visitor, by the identifier in their messages."""
    return gui._container_handle_from_uuid


def commands(gui: viser.GuiApi) -> Mapping[str, viser.CommandHandle]:
    """Return the commands of a page or of one visitor, by the identifier in their messages."""
    return gui._command_handle_from_uuid


def uploads(gui: viser.GuiApi) -> Mapping[str, Any]:
    """Return the uploads that have begun and not ended, by the name of the transfer."""
    return gui._current_file_upload_states


def identifier(control: Any) -> str:
    """Return the identifier of a control, which is also the id of its element on the page."""
    return control._impl.uuid


def is_removed(handle: Any) -> bool:
    """Return True if a control or a scene node is no longer on the page."""
    return handle._impl.removed


def connections(server: viser.ViserServer) -> Mapping[int, Any]:
    """Return the open websockets by the number of the client; it has no handle before its camera is known."""
    return server._websock_server._live_connections


def client_handle(server: viser.ViserServer, number: int) -> viser.ClientHandle | None:
    """Return the handle of a client, None before its camera is known and after it has left. Takes no lock."""
    return server._connected_clients.get(number)


def run_script(target: viser.ClientHandle | viser.ViserServer, source: str) -> None:
    """Run JavaScript on a visitor's page, or on those of all visitors, later ones too.

    Texts in it must go through `json.dumps`.
    """
    sender = target._websock_server if isinstance(target, viser.ViserServer) else target._websock_connection
    sender.queue_message(_messages.RunJavascriptMessage(source))


SENDER = """
if (!window.aeroSend) {
  const post = Worker.prototype.postMessage, waiting = [];
  let worker = null;
  window.aeroKeepsBack = () => false;
  window.aeroSend = message => worker ? post.call(worker, {type: "send", message}) : waiting.push(message);
  Worker.prototype.postMessage = function (data, ...rest) {
    if (data?.type === "send") {
      worker = this;
      waiting.splice(0).forEach(aeroSend);
      if (aeroKeepsBack(data.message)) return;
    }
    return post.call(this, data, ...rest);
  };
}
"""
"""Script that lets others send messages to the server, with `aeroSend`, and keep back those of the page."""
CHARTS = "Object.values(window.__viserTestpoints?.uplots ?? {}).map(({chart}) => chart)"
"""Expression of JavaScript: the charts of uPlot on the page, which viser shows its own tests."""


def show(client: viser.ClientHandle, identifier: str, **properties: Any) -> None:
    """Make one client's page show other properties of a shared control, such as its value."""
    client._websock_connection.queue_message(_messages.GuiUpdateMessage(identifier, properties))


def end_upload(client: viser.ClientHandle, button: str, transfer: str, size: int) -> None:
    """Tell a client's page that a file has arrived, so that it sends no more of it."""
    client._websock_connection.queue_message(_messages.FileTransferPartAck(button, transfer, size, size))


def hide_upload(client: viser.ClientHandle, transfer: str) -> None:
    """Remove the notification that a client's page shows of an upload. It does not come back with a later answer."""
    client._websock_connection.queue_message(_messages.RemoveNotificationMessage(f"upload-{transfer}"))


def wait_until_drawn(client: viser.ClientHandle) -> None:
    """Wait until the page of a visitor has drawn all that it was sent, or the visitor has left, for 6 s at most.

    A page handles its messages in order, between two pictures. It therefore answers when it has drawn what came before.
    """
    deadline = time.monotonic() + _DRAWN_MAX
    with contextlib.suppress(RuntimeError, TimeoutError):
        for _ in range(_PICTURES):
            client.local_storage.get_item("aero-viz-drawn", timeout=max(deadline - time.monotonic(), 0.0))


def mend(server: viser.ViserServer, on_leave: Callable[[int], object]) -> None:
    """Make the wake-ups of a server safe, and its acknowledgements of uploads private.

    Args:
        server: a server that has just been started.
        on_leave: called with the number of a client whose connection has ended.
    """
    websock, loop = server._websock_server, server.get_event_loop()
    websock.get_message_buffer().message_event = LoopEvent(loop)

    async def prepare(client: Any) -> None:
        client.get_message_buffer().message_event = LoopEvent(loop)

    websock.on_client_connect(prepare)
    websock.on_client_disconnect(lambda client: on_leave(client.client_id))  # type: ignore[arg-type,return-value]
    broadcast = websock.queue_message

    def queue_message(message: Any) -> None:
        # viser tells all pages, later ones too, which then show the upload of a file without a name.
        if not isinstance(message, _messages.FileTransferPartAck):
            broadcast(message)
            return
        upload = uploads(server.gui).get(message.transfer_uuid)
        client = None if upload is None else client_handle(server, upload["client_id"])
        if client is not None:
            client._websock_connection.queue_message(message)

    websock.queue_message = queue_message  # type: ignore[method-assign]


class LoopEvent(asyncio.Event):
    """An event that is set on its event loop only.

    viser's message buffer sets its event twice: on the thread that sends a message, and on the event loop, after the
    message or after the atomic update that it belongs to. The first time counts for nothing. Just before the event loop
    starts to wait, it would leave the event set while somebody waits for it: the event could not be set again, and no
    message would be sent until another client connects. And it would wake the event loop for every message of an
    update.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        super().__init__()
        self._target_loop = loop

    def set(self) -> None:
        """Set the event if called on its loop."""
        if asyncio._get_running_loop() is self._target_loop:
            super().set()


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
