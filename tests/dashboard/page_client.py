"""A client that speaks to the server as the page does, and as a hostile one would."""

import time
from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import viser
import zstandard
from websockets.sync.client import connect
from websockets.sync.connection import Connection

from aero_viz.dashboard.server import LocalServer

CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.0, 0.0, 1.0), "fov": 1, "near": 0.1,
    "far": 100, "image_height": 600, "image_width": 800.5, "look_at": (1.0, 0.0, 1.0), "up_direction": (0.0, 0.0, 1.0),
}  # fmt: skip
"""The first message of a page; viser counts a client from then on."""


def join(
    server: LocalServer | None = None,
    headers: Sequence[tuple[str, str]] = (),
    *,
    path: str = "",
    url: str | None = None,
    **options: Any,
) -> Connection:
    """Open a websocket to the server, or at a `url`, as the page does."""
    protocol: Any = f"viser-v{viser.__version__}"
    if url is None:
        assert server is not None
        url = server.url.replace("http", "ws") + path
    # A client that stops reading what it does not need would miss the answer when it closes, and wait for 10 s.
    options = {"max_size": None, "max_queue": None, "open_timeout": 60.0} | options
    return connect(url, subprotocols=[protocol], additional_headers=headers, **options)


def send(client: Connection, **message: Any) -> None:
    """Send a message with these fields."""
    client.send(msgspec.msgpack.encode(message))


def read_until(client: Connection, text: str, timeout: float = 300.0) -> str:
    """Read messages of the server until one contains `text`; return what they say."""
    deadline, heard = time.monotonic() + timeout, ""
    while text not in heard:
        data = client.recv(timeout=max(deadline - time.monotonic(), 0.01))
        assert isinstance(data, bytes)
        size = int.from_bytes(data[8:16], "little")
        heard += zstandard.ZstdDecompressor().decompress(data[16 : 16 + size]).decode(errors="replace")
    return heard


def wait_for(condition: Callable[[], object], description: str, timeout: float = 300.0) -> None:
    """Wait until `condition` holds."""
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline, f"waited for {description}"
        time.sleep(0.01)
