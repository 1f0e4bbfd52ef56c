"""Where the page listens and what it refuses; no browser needed."""

from __future__ import annotations

import logging
import socket
import time

import msgspec
import pytest
import viser
from websockets.sync.client import ClientConnection, connect

from aero_viz.dashboard.server import LocalServer
from aero_viz.errors import UserError


@pytest.fixture
def server():
    server = LocalServer(port=0)
    yield server
    server.stop()


def join(server: LocalServer) -> ClientConnection:
    """Speak to the server as the page does."""
    protocol = f"viser-v{viser.__version__}"
    return connect(server.url.replace("http", "ws"), subprotocols=[protocol], max_size=None)  # type: ignore[list-item]


def test_the_page_is_only_for_this_machine_unless_asked(server):
    assert server.url == f"http://127.0.0.1:{server.get_port()}"
    assert server.get_host() == "127.0.0.1"


def test_a_taken_port_is_an_error_that_names_it():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(UserError, match=rf"Port {port} on 127.0.0.1 .* --port"):
            LocalServer(port=port)


@pytest.mark.parametrize(("host", "port"), [("203.0.113.7", 0), ("127.0.0.1", 70_000)])
def test_an_impossible_address_is_an_error(host, port):
    with pytest.raises(UserError, match=host):
        LocalServer(host=host, port=port)


def test_a_request_to_share_the_page_publicly_is_refused(server, caplog):
    with caplog.at_level(logging.WARNING), join(server) as client:
        client.send(msgspec.msgpack.encode({"type": "ShareUrlRequest"}))
        deadline = time.monotonic() + 10.0
        while "refused" not in caplog.text:
            assert time.monotonic() < deadline, "the request was not answered"
            time.sleep(0.02)
        assert server._share_tunnel is None
    assert server.request_share_url() is None


def test_nothing_is_printed(capsys):
    LocalServer(port=0).stop()
    assert capsys.readouterr().out == ""
