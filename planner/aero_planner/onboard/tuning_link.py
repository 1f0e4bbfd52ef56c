"""The node's end of the connection to one viewer who may hold the key to change parameters."""

from __future__ import annotations

import logging
from typing import Any

from aero_planner.onboard.sealed_channel import SealedChannel, new_nonce
from aero_planner.onboard.telemetry_protocol import Kind, Message, MessageReader, encode
from aero_planner.onboard.tuning import Request, Tuning

_log = logging.getLogger(__name__)

_LARGEST = 1 << 16
"""Largest content of a viewer's message [bytes]."""


class TuningLink:
    """Reads what a viewer sends, and tells it about the parameters.

    A viewer proves that it holds the key with its first message. Whoever sends one that does not verify can only watch
    from then on, and what it has asked for is not done.

    Args:
        tuning: the parameters.
        sender: name of the viewer in the log.
    """

    def __init__(self, tuning: Tuning, sender: str) -> None:
        self._tuning, self._sender = tuning, sender
        self._nonce = new_nonce()
        self._reader = MessageReader(largest=_LARGEST)
        self._channel: SealedChannel | None = None
        self._request: Request | None = None
        self._denied = ""

    @property
    def greeting(self) -> dict[str, Any]:
        """What the viewer's first message says about the parameters."""
        return {"planner": self._tuning.config.to_dict(), "nonce": self._nonce}

    def receive(self, data: bytes) -> bool:
        """Read bytes of the viewer; return True if its status has changed."""
        if self._denied:
            return False
        try:
            messages = self._reader.feed(data)
            for message in messages:
                self._read(message)
            return bool(messages)
        except ValueError as error:
            self.abandon()
            self._channel, self._denied = None, f"a message was refused: {str(error).rstrip('.')}"
            _log.warning("viewer %s can only watch from now on: %s", self._sender, self._denied)
            return True

    def status(self) -> bytes:
        """Return the message that tells the viewer the present parameters and the answer to its last request."""
        content = self._tuning.status(self._request)
        if self._channel is None:
            return encode(Kind.STATUS, {**content, "denied": self._denied})
        return encode(Kind.STATUS, self._channel.seal(content))

    def abandon(self) -> None:
        """Drop a request that still waits."""
        if self._request is not None:
            self._request.abandoned = True

    def _read(self, message: Message) -> None:
        is_first, channel = self._channel is None, self._channel
        if channel is None:
            channel = SealedChannel(self._tuning.key, self._nonce, message.values.get("nonce"), is_node=True)
        content = channel.open(message.values)
        self._channel = channel
        if is_first:
            _log.info("viewer %s holds the key and may change parameters", self._sender)
            return
        self.abandon()  # the newest counts
        self._request = Request(channel.received, self._sender, content)
        self._tuning.submit(self._request)
