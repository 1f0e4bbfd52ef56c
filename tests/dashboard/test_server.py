"""Addresses of the server and the requests that it refuses, without a browser."""

import contextlib
import logging
import socket
import time
import urllib.request

import pytest

from aero_viz.dashboard.server import LocalServer
from aero_viz.errors import UserError
from tests.dashboard.page_client import CAMERA, join, send


def test_the_page_listens_on_this_machine_only_by_default(server):
    assert server.url == f"http://127.0.0.1:{server.get_port()}"
    assert server.get_host() == "127.0.0.1"


@pytest.mark.parametrize(("host", "shown"), [("::1", "[::1]"), ("::", "[::1]"), ("0.0.0.0", "127.0.0.1")])
def test_the_printed_address_opens_the_page(host, shown):
    if ":" in host and not has_ipv6():
        pytest.skip("this machine has no IPv6")
    server = LocalServer(host=host, port=0)
    try:
        assert server.url == f"http://{shown}:{server.get_port()}"
        cookies = urllib.request.HTTPCookieProcessor()  # the token of the link becomes a cookie
        with urllib.request.build_opener(cookies).open(server.link(), timeout=60.0) as answer:
            assert answer.status == 200
    finally:
        server.stop()


def has_ipv6() -> bool:
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET6) as probe:
        probe.bind(("::1", 0))
        return True
    return False


def test_a_taken_port_is_an_error_that_names_it():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(UserError, match=rf"Port {port} on 127.0.0.1 .* --port"):
            LocalServer(port=port)


@pytest.mark.parametrize(
    ("host", "port", "words"),
    [
        ("203.0.113.7", 0, r"203\.0\.113\.7 is not an address of this machine; choose another one with --host"),
        ("nobody.invalid", 0, r"nobody\.invalid is not an address of this machine; choose another one with --host"),
        ("127.0.0.1", 70_000, r"The port 70000 does not exist; give --port"),
    ],
)
def test_an_impossible_address_is_an_error_that_tells_which_flag_to_change(host, port, words):
    with pytest.raises(UserError, match=words):
        LocalServer(host=host, port=port)


def test_a_request_to_share_the_page_publicly_is_refused(server, caplog, capsys):
    with caplog.at_level(logging.WARNING), join(server) as client:
        send(client, **CAMERA)  # the only visitor holds control
        send(client, type="ShareUrlRequest")
        deadline = time.monotonic() + 60.0
        while "refused" not in caplog.text:
            assert time.monotonic() < deadline, "the request was not answered"
            time.sleep(0.02)
        server.disconnect_share_url()
        assert "already disconnected" in capsys.readouterr().out
    assert server.request_share_url() is None


def test_nothing_is_printed(capsys):
    LocalServer(port=0).stop()
    assert capsys.readouterr().out == ""
