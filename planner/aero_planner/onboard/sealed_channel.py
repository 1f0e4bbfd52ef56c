"""Messages between two programs that hold a key: forged, replayed and reordered ones are refused.

Both ends choose a nonce per connection; its key is their HMAC-SHA256 under the shared key. A message carries a counter,
which must rise, and the HMAC of direction, counter and text. Messages are authentic but not secret.
"""

from __future__ import annotations

import hmac
import json
import re
import secrets
from collections.abc import Mapping
from typing import Any

from aero_planner.user_file import parse_json

_NONCE_BYTES = 16


def new_nonce() -> str:
    """Return a number that is used once, as hexadecimal digits."""
    return secrets.token_hex(_NONCE_BYTES)


class SealedChannel:
    """One end of a connection.

    Args:
        key: the shared key.
        node_nonce, viewer_nonce: what either end has chosen for this connection, see `new_nonce`.
        is_node: True at the node, False at the viewer.

    Attributes:
        received: counter of the last message from the other end.

    Raises:
        ValueError: a nonce is malformed.
    """

    def __init__(self, key: bytes, node_nonce: Any, viewer_nonce: Any, *, is_node: bool) -> None:
        for nonce in (node_nonce, viewer_nonce):
            if not isinstance(nonce, str) or not re.fullmatch(f"[0-9a-f]{{{2 * _NONCE_BYTES}}}", nonce):
                raise ValueError("its nonce is malformed")
        self._key = hmac.digest(key, f"aero-planner {node_nonce} {viewer_nonce}".encode(), "sha256")
        self._sender, self._peer = ("node", "viewer") if is_node else ("viewer", "node")
        self._sent = self.received = 0

    def seal(self, content: Mapping[str, Any]) -> dict[str, Any]:
        """Return a message with `content`, which JSON can represent."""
        self._sent += 1
        text = json.dumps(dict(content))
        return {"counter": self._sent, "text": text, "tag": self._tag(self._sender, self._sent, text)}

    def open(self, message: Mapping[str, Any]) -> dict[str, Any]:
        """Return the content of a message from the other end.

        Raises:
            ValueError: the message was not sealed by the other end of this connection, or not later than the last one.
        """
        counter, text, tag = (message.get(name) for name in ("counter", "text", "tag"))
        if type(counter) is not int or not isinstance(text, str) or not isinstance(tag, str):
            raise ValueError("it is not sealed")
        if not hmac.compare_digest(self._tag(self._peer, counter, text).encode(), _encoded(tag)):
            raise ValueError("it was sealed with another key, or altered")
        if counter <= self.received:
            raise ValueError(f"it is an old one: message {counter} came after {self.received}")
        self.received = counter
        content = parse_json(text)
        if not isinstance(content, dict):
            raise ValueError("its content is malformed")
        return content

    def _tag(self, sender: str, counter: int, text: str) -> str:
        return hmac.new(self._key, _encoded(f"{sender} {counter} {text}"), "sha256").hexdigest()


def _encoded(text: str) -> bytes:
    """Return the bytes of a text that may have surrogates, as JSON allows."""
    return text.encode(errors="surrogatepass")
