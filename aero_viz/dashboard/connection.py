"""The websocket of one client. It passes on the messages that a page may send, and drops all others."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from typing import Any

import viser

from aero_viz.dashboard import viser_private
from aero_viz.dashboard.message_limit import MessageLimit
from aero_viz.dashboard.number_fields import NumberFields, typed_value
from aero_viz.dashboard.page_messages import (
    CameraMessage,
    FormMessage,
    NumberMessage,
    PageMessage,
    UploadPart,
    UploadStart,
    ValueMessage,
    accepted_value,
    control_name,
    decode,
    is_own,
    replaces_earlier,
    value_message,
)
from aero_viz.dashboard.tokens import Role
from aero_viz.dashboard.visitors import Visitors
from aero_viz.errors import UserError
from aero_viz.guests import GuestConnection

_log = logging.getLogger(__name__)
MESSAGE_MAX = 1 << 20
"""Largest message of a page [bytes]; the page sends files in parts of 512 kB."""
_WATCHER_MESSAGE_MAX = 1 << 16
"""Largest message of a page that can only watch [bytes]."""
_PICTURE_MAX = 50 << 20
"""Largest message with a picture that was asked for [bytes]."""
_PARTS_MAX = 10_000
"""Largest number of parts of a file; the page sends parts of 512 kB."""
_MESSAGES_IN_A_ROW = 16
"""Largest number of messages that are read from one client before the others get a turn."""
_UNSENT_MAX = 32768
"""Largest amount of data that waits in the kernel until the network takes it [bytes]; an update has about 40 kB."""
_REFUSAL_SECONDS = 12.0
"""Time for which the page says why a number is refused [s]."""
_REMINDER_PERIOD = 5.0
"""Shortest time between two reminders that a visitor cannot change the page [s]."""


class _NoControl(ValueError):
    """A visitor without control has used a shared control."""


class _TooLarge(ValueError):
    """A visitor uploads a file that is too large, and has been told so."""


class PageConnection(GuestConnection):
    """Connection that viser receives messages from.

    viser sets any attribute of a control that a message names, keeps the parts of any number of files of any size, and
    ends with a traceback where a message has other fields or types than it expects. Here a message is checked first,
    and a flood is thinned out (`MessageLimit`).
    Elements of the client alone (`client.gui`, `client.scene`) can always be used; elements of the server can be used
    only by the visitor who holds control.

    Args:
        arguments: those of `GuestConnection`.
        page: server of the page.
        visitors: visitors of the page.
        number_fields: the fields that they type in.
        answers: what to do with messages that viser does not know, by their type.
        upload_limit: size of the largest file that a client may upload [bytes]. One upload runs at a time.
        catch_up: returns a future that is done when the session has run all commands of the page.
        options: those of `GuestConnection`.
    """

    def __init__(
        self,
        *arguments: Any,
        page: viser.ViserServer,
        visitors: Visitors,
        number_fields: NumberFields,
        answers: Mapping[type[PageMessage], Callable[[viser.ClientHandle, Any], object]],
        upload_limit: int,
        catch_up: Callable[[], Future[Any]],
        **options: Any,
    ) -> None:
        super().__init__(*arguments, **options)
        self.role = Role.CONTROL
        """Role that the link of this client gives."""
        self._page = page
        self._visitors = visitors
        self._number_fields = number_fields
        self._answers = answers
        self._reminder_due = 0.0
        self._upload_limit = upload_limit
        self._upload: UploadStart | None = None
        self._refused = ""
        """Name of the last transfer that was refused."""
        self._bytes_left = 0
        """Bytes of the announced file that have not arrived yet."""
        self._parts_left: set[int] = set()
        """Parts of it that have not arrived yet."""
        self._limit: MessageLimit[tuple[PageMessage, bytes]] = MessageLimit(catch_up)
        self._admitted: deque[tuple[PageMessage, bytes]] = deque()
        """Messages that have been read but not handled yet."""
        self._received = 0
        """Number of messages that have been read."""
        self._warned = False
        self._number: int | None = None
        """Number of this client in viser."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin to serve the client, and limit what waits for a slow network.

        What the kernel has taken is sent, however old it is by then. What waits in viser is replaced by newer updates.
        """
        super().connection_made(transport)
        client = transport.get_extra_info("socket")
        if client is not None and hasattr(socket, "TCP_NOTSENT_LOWAT"):
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, _UNSENT_MAX)

    def limit_messages(self) -> None:
        """Limit the size of a message: whoever only watches sends no files, and a picture is sent on request."""
        self.protocol.max_message_size = MESSAGE_MAX if self.role is Role.CONTROL else _WATCHER_MESSAGE_MAX

    @contextlib.contextmanager
    def rendering(self) -> Iterator[None]:
        """Let the client send a picture, which was asked for, while the context is open."""
        self.protocol.max_message_size = _PICTURE_MAX
        try:
            yield
        finally:
            self.limit_messages()

    async def recv(self, decode: bool | None = None) -> Any:
        """Return the next message that a page may send."""
        while True:
            try:
                while not self._admitted:
                    await self._receive(decode)
                checked = self._checked(*self._admitted.popleft())
                if checked is not None:
                    return checked
            except _NoControl:
                self._remind()
            except _TooLarge:
                pass
            except ValueError as error:
                self._warn(f"A message is ignored, since no page sends it: {error}.")

    async def _receive(self, is_text: bool | None) -> None:
        """Add the messages to handle next to `_admitted`, if any are due; ValueError if no page sends them."""
        self._received += 1
        if self._received % _MESSAGES_IN_A_ROW == 0:
            await asyncio.sleep(0)  # websockets does not yield as long as messages wait
        try:
            async with asyncio.timeout(self._limit.delay):
                data = await super().recv(is_text)
        except TimeoutError:
            self._admitted += self._limit.due()
            return
        if not isinstance(data, bytes):
            raise ValueError("it is a text")
        message = decode(data)
        name = control_name(message)
        if name is None:
            self._admitted.append((message, data))
        else:
            is_click = not replaces_earlier(message, self._control(message))
            self._admitted += self._limit.admit((type(message), name), (message, data), is_click=is_click)

    def _control(self, message: PageMessage) -> Any:
        """Return the control whose value a message sets, None if there is none."""
        if not isinstance(message, ValueMessage):
            return None
        client = self._client()
        gui = client.gui if client is not None and is_own(message, client) else self._page.gui
        return viser_private.inputs(gui).get(message.uuid)

    def _checked(self, message: PageMessage, data: bytes) -> bytes | None:
        """Return the message to pass on to viser, None if there is none. Raises ValueError unless a page may send it
        now."""
        client, number = self._client(), self._number
        assert number is not None
        if isinstance(message, CameraMessage):
            self._visitors.join(number, may_control=self.role is Role.CONTROL)
        own = is_own(message, client)
        if not own and not self._visitors.has_control(number):
            if isinstance(message, (ValueMessage, NumberMessage)):
                self._show_value(message.uuid)
            raise _NoControl
        gui = client.gui if own and client is not None else self._page.gui
        if isinstance(message, ValueMessage):
            return self._clamped(message, data, gui)
        if isinstance(message, NumberMessage):
            return self._typed(message, gui)
        if (answer := self._answers.get(type(message))) is not None:
            if client is not None:
                answer(client, message)
            return None
        if isinstance(message, FormMessage):
            if message.uuid not in viser_private.containers(gui):
                raise ValueError("there is no such form")
        elif isinstance(message, UploadStart):
            self._start_upload(message)
        elif isinstance(message, UploadPart):
            self._continue_upload(message)
        return data

    def _clamped(self, message: ValueMessage, data: bytes, gui: viser.GuiApi) -> bytes:
        """Return the message with its value clamped to the bounds of the control; the page shows a clamped value."""
        control = viser_private.inputs(gui).get(message.uuid)
        if control is None:
            raise ValueError("there is no such control")
        sent, fitted = message.updates.value, control.value
        try:
            fitted = accepted_value(control, sent)
        finally:
            if fitted != sent:
                self._show_value(message.uuid, fitted)
        if fitted == sent:
            return data
        return value_message(message.uuid, fitted)

    def _typed(self, message: NumberMessage, gui: viser.GuiApi) -> bytes | None:
        """Return the message that sets a number which was typed, None before it counts and where it is refused."""
        control, client = viser_private.inputs(gui).get(message.uuid), self._client()
        if not message.is_over:
            self._number_fields.type(self._number, control)
            return None
        self._number_fields.leave(self._number, with_number=message.text is not None)
        if message.text is None:
            return None
        try:
            return value_message(message.uuid, typed_value(control, message.index, message.text))
        except UserError as error:
            self._show_value(message.uuid)
            if client is not None:
                client.add_notification("Not taken", str(error), color="red", auto_close_seconds=_REFUSAL_SECONDS)
            return None

    def _show_value(self, uuid: str, value: Any = None) -> None:
        """Make this client's page show a value of a shared control: `value`, or the control's own."""
        control, client = viser_private.inputs(self._page.gui).get(uuid), self._client()
        if (
            client is None
            or not isinstance(control, viser.GuiInputHandle)
            or isinstance(control, viser.GuiButtonHandle)
        ):
            return
        viser_private.show(client, uuid, value=control.value if value is None else value)

    def _remind(self) -> None:
        """Tell a visitor without control how to change a shared control."""
        client = self._client()
        if client is not None and time.monotonic() > self._reminder_due:
            self._reminder_due = time.monotonic() + _REMINDER_PERIOD
            may = self.role is Role.CONTROL
            text = 'Press "Take control" to change this.' if may else "This link cannot control the session."
            client.add_notification("You are watching", text, color="yellow", auto_close_seconds=_REMINDER_PERIOD)

    def _start_upload(self, start: UploadStart) -> None:
        button = viser_private.inputs(self._page.gui).get(start.source_component_uuid)
        if not isinstance(button, viser.GuiUploadButtonHandle) or button.disabled:
            raise ValueError("there is no such button")
        if start.transfer_uuid in viser_private.uploads(self._page.gui) or self._parts_left:
            raise ValueError("another upload is still running")
        if start.size_bytes > self._upload_limit:
            self._refuse_upload(start)
            raise _TooLarge
        if start.part_count > min(start.size_bytes, _PARTS_MAX) or (start.size_bytes and not start.part_count):
            raise ValueError("its number of parts is impossible")
        self._upload, self._bytes_left, self._parts_left = start, start.size_bytes, set(range(start.part_count))

    def _continue_upload(self, part: UploadPart) -> None:
        upload, size = self._upload, len(part.content)
        if part.transfer_uuid == self._refused:  # the page sends it all the same
            raise _TooLarge
        if upload is None or part.transfer_uuid != upload.transfer_uuid or part.part_index not in self._parts_left:
            raise ValueError("it is part of a file that was not announced")
        most = self._bytes_left - len(self._parts_left) + 1  # no part is empty
        least = most if len(self._parts_left) == 1 else 1
        if not least <= size <= most or part.source_component_uuid != upload.source_component_uuid:
            raise ValueError("it does not belong to the announced file")
        self._bytes_left -= size
        self._parts_left.remove(part.part_index)

    def hide_upload(self) -> None:
        """Remove the notification of the last upload. The page itself shows it, and says that the file was uploaded
        successfully as soon as all of it has arrived."""
        client = self._client()
        if client is not None and self._upload is not None:
            viser_private.hide_upload(client, self._upload.transfer_uuid)

    def _refuse_upload(self, start: UploadStart) -> None:
        """Tell the client why, and end the upload on the page."""
        self._refused, client = start.transfer_uuid, self._client()
        if client is None:
            return
        viser_private.end_upload(client, start.source_component_uuid, start.transfer_uuid, start.size_bytes)
        viser_private.hide_upload(client, start.transfer_uuid)
        client.add_notification(
            "Error",
            f"{start.filename} has {start.size_bytes / 1000:.0f} kB and is not uploaded: the page takes files of up to "
            f"{self._upload_limit / 1000:.0f} kB. A recording is played with: aero-viz play FILE",
            color="red",
        )

    def _client(self) -> viser.ClientHandle | None:
        """Return viser's handle of this client, None until its camera is known."""
        if self._number is None:
            connections = viser_private.connections(self._page)
            self._number = next(number for number, connection in connections.items() if connection is self)
        return viser_private.client_handle(self._page, self._number)

    def _warn(self, text: str) -> None:
        """Log the first problem of a client; a flood of messages must not become a flood of log lines."""
        if not self._warned:
            self._warned = True
            _log.warning("%s", text)
