"""Scripts on the pages of visitors, for functions that viser's controls do not offer."""

from __future__ import annotations

import viser
from viser import _messages


def run_script(client: viser.ClientHandle, source: str) -> None:
    """Run JavaScript on a visitor's page. Texts in it must go through `json.dumps`."""
    client._websock_connection.queue_message(_messages.RunJavascriptMessage(source))
