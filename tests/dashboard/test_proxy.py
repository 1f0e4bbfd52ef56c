"""The page behind a proxy that serves it below a path, as jupyter-server-proxy does at /proxy/PORT/."""

import http.client
import socket
import threading
from collections.abc import Iterator
from contextlib import closing, suppress

import pytest
from websockets.exceptions import InvalidStatus

from aero_viz.dashboard.server import LocalServer
from tests.dashboard.page_client import join, read_until


class PathProxy:
    """Forwards connections to a server on this machine, without the path /proxy/PORT, whatever is said on them."""

    def __init__(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        threading.Thread(target=self._serve, daemon=True).start()

    def close(self) -> None:
        self._listener.close()

    def _serve(self) -> None:
        with suppress(OSError):  # closed
            while True:
                client, _ = self._listener.accept()
                threading.Thread(target=self._forward, args=(client,), daemon=True).start()

    def _forward(self, client: socket.socket) -> None:
        head = b""
        while b"\r\n\r\n" not in head:
            head += client.recv(65536)
        method, path, rest = head.split(b" ", 2)
        _, _, port, inner = path.split(b"/", 3)
        with closing(socket.create_connection(("127.0.0.1", int(port)))) as server:
            server.sendall(b" ".join((method, b"/" + inner, rest)))
            back = threading.Thread(target=self._pump, args=(server, client), daemon=True)
            back.start()
            self._pump(client, server)
            back.join(timeout=60.0)

    @staticmethod
    def _pump(source: socket.socket, sink: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(65536):
                sink.sendall(data)
            sink.shutdown(socket.SHUT_WR)


@pytest.fixture
def proxy() -> Iterator[PathProxy]:
    proxy = PathProxy()
    yield proxy
    proxy.close()


def serve(proxy: PathProxy, *, name: str, allowed: bool) -> Iterator[LocalServer]:
    hosts = (name,) if allowed else ()
    server = LocalServer(port=0, allowed_hosts=hosts, embedders=(f"http://{name}:{proxy.port}",))
    yield server
    server.stop()


def ask(proxy: PathProxy, path: str, host: str, **headers: str) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("127.0.0.1", proxy.port, timeout=60.0)
    connection.request("GET", path, headers={"Host": host, "Connection": "close"} | headers)
    return connection.getresponse()


def connect_through(proxy: PathProxy, server: LocalServer, host: str, query: str = "", **headers: str):
    headers = {"Origin": f"http://{host}"} | headers
    with closing(socket.create_connection(("127.0.0.1", proxy.port))) as sock:
        url = f"/proxy/{server.get_port()}/{query}"
        with join(server, list(headers.items()), url=f"ws://{host}{url}", sock=sock) as client:
            read_until(client, "/light/sun")


def test_a_notebook_on_this_machine_shows_the_page_in_a_frame(proxy: PathProxy):
    for server in serve(proxy, name="localhost", allowed=False):
        host = f"localhost:{proxy.port}"
        answer = ask(proxy, f"/proxy/{server.get_port()}/", host)
        assert answer.status == 200
        assert f"frame-ancestors http://{host}" in answer.headers["Content-Security-Policy"]
        connect_through(proxy, server, host)
        with pytest.raises(InvalidStatus):  # a page that another server on this machine serves
            connect_through(proxy, server, host, Origin="http://localhost:1")


def test_a_notebook_on_another_machine_needs_its_name_and_the_link(proxy: PathProxy):
    host = f"hub.example.org:{proxy.port}"
    for server in serve(proxy, name="hub.example.org", allowed=False):
        answer = ask(proxy, f"/proxy/{server.get_port()}/", host)
        assert answer.status == 403 and b"--allow-host" in answer.read()
    for server in serve(proxy, name="hub.example.org", allowed=True):
        below, query = f"/proxy/{server.get_port()}/", server.link().partition("?")[2]
        assert ask(proxy, below, host).status == 401
        opened = ask(proxy, f"{below}?{query}", host)
        # The way back from the link is relative: it stays below the path of the proxy.
        assert opened.status == 303 and opened.headers["Location"] == "?"
        cookie = opened.headers["Set-Cookie"].partition(";")[0]
        assert ask(proxy, below, host, Cookie=cookie).status == 200
        connect_through(proxy, server, host, Cookie=cookie)
        with pytest.raises(InvalidStatus):
            connect_through(proxy, server, host)
