"""Requests that the server of the page answers."""

import http.client

import pytest
from websockets.exceptions import InvalidStatus

from aero_viz.dashboard.server import LocalServer
from tests.dashboard.page_client import join, read_until


@pytest.mark.parametrize(
    "headers", [[("Origin", "http://evil.example")], [("Origin", "null")], [("Host", "evil.example")]]
)
def test_a_foreign_page_gets_neither_the_scene_nor_a_connection(server: LocalServer, headers):
    with pytest.raises(InvalidStatus) as refusal:
        join(server, headers)
    assert refusal.value.response.status_code == 403
    assert not server.get_clients()


@pytest.mark.parametrize("origin", [True, False])
def test_the_own_page_and_a_program_get_the_scene(server: LocalServer, origin):
    with join(server, [("Origin", server.url)] if origin else []) as client:
        read_until(client, "/light/sun")


def test_a_foreign_name_does_not_get_the_files_of_the_page(server: LocalServer):
    for host, status in ((None, 200), ("evil.example", 403)):
        connection = http.client.HTTPConnection("127.0.0.1", server.get_port(), timeout=60.0)
        connection.request("GET", "/", headers={"Host": host} if host else {})
        answer = connection.getresponse()
        assert answer.status == status
        assert answer.headers["X-Frame-Options"] == "DENY"
        policy = answer.headers["Content-Security-Policy"]
        assert "default-src 'self'" in policy and "http" not in policy and "*" not in policy
        assert "Access-Control-Allow-Origin" not in answer.headers
        connection.close()
