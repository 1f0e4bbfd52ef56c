"""Scripts that run on the pages of visitors, and a wait until a page has drawn, neither of which viser offers."""

from __future__ import annotations

import contextlib
import time

import viser
from viser import _messages

_DRAWN_MAX = 6.0
"""Longest wait for a picture [s]. The page of a visitor who looks at another tab may draw nothing."""
_PICTURES = 3
"""Pictures that a page draws until one shows what was sent: messages wait for the next one, nodes for another."""


def run_script(target: viser.ClientHandle | viser.ViserServer, source: str) -> None:
    """Run JavaScript on a visitor's page, or on those of all visitors, later ones too.

    Texts in it must go through `json.dumps`.
    """
    sender = target._websock_server if isinstance(target, viser.ViserServer) else target._websock_connection
    sender.queue_message(_messages.RunJavascriptMessage(source))


def wait_until_drawn(client: viser.ClientHandle) -> None:
    """Wait until the page of a visitor has drawn all that it was sent, or the visitor has left, for 6 s at most.

    A page handles its messages in order, between two pictures. It therefore answers when it has drawn what came before.
    """
    deadline = time.monotonic() + _DRAWN_MAX
    with contextlib.suppress(RuntimeError, TimeoutError):
        for _ in range(_PICTURES):
            client.local_storage.get_item("aero-viz-drawn", timeout=max(deadline - time.monotonic(), 0.0))
