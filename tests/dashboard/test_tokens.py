"""Links with tokens, with real requests."""

import http.client

import pytest
from websockets import Headers
from websockets.exceptions import InvalidStatus

from aero_viz.dashboard.server import LocalServer
from aero_viz.dashboard.tokens import Role, Tokens
from tests.dashboard.page_client import CAMERA, join, read_until, send, wait_for


def query(server: LocalServer, *, view_only: bool = False) -> str:
    return server.link(view_only=view_only).removeprefix(server.url)


def get(server: LocalServer, path: str, headers: dict[str, str] | None = None) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("127.0.0.1", server.get_port(), timeout=60.0)
    connection.request("GET", path, headers=headers or {})
    answer = connection.getresponse()
    answer.read()
    return answer


def cookie_of(answer: http.client.HTTPResponse) -> dict[str, str]:
    return {"Cookie": answer.headers["Set-Cookie"].partition(";")[0]}


def test_on_this_machine_alone_no_token_is_required(server: LocalServer):
    assert server.link() == server.url and get(server, "/").status == 200


@pytest.mark.parametrize(
    "path", ["/", "/index.html", "/?token=", "/?token=guess", "/?token={0}&token={0}", "/?Token={0}"]
)
def test_without_a_valid_token_nothing_is_answered(public: LocalServer, path):
    path = path.format(query(public).partition("=")[2])
    answer = get(public, path)
    assert answer.status == 401 and "Set-Cookie" not in answer.headers
    with pytest.raises(InvalidStatus) as refusal:
        join(public, path=path)
    assert refusal.value.response.status_code == 401
    assert not public.visitors.count


def test_a_proxy_is_a_way_for_other_machines_too():
    server = LocalServer(port=0, allowed_hosts=["viz.example.org"])
    try:
        assert get(server, "/").status == 401
        assert get(server, "/", {"Host": "viz.example.org"}).status == 401
        assert server.addresses == ["https://viz.example.org"]
    finally:
        server.stop()


def test_the_entries_of_a_link_stay_when_its_token_becomes_a_cookie(public: LocalServer):
    setting = "source=datasets/forest_mid360.mcap&seed=3&" + "&".join(f"costs.q_{i}=%C3%BC" for i in range(20))
    answer = get(public, f"{query(public)}&{setting}")
    assert answer.status == 303 and answer.headers["Location"] == f"./?{setting}"
    assert get(public, f"/?{setting}", cookie_of(answer)).status == 200


@pytest.mark.parametrize("view_only", [False, True])
def test_a_link_moves_its_token_to_a_cookie_that_opens_page_and_websocket(public: LocalServer, view_only):
    answer = get(public, query(public, view_only=view_only))
    assert answer.status == 303 and answer.headers["Location"] == "./"
    assert "HttpOnly" in answer.headers["Set-Cookie"] and "SameSite=Lax" in answer.headers["Set-Cookie"]
    cookie = cookie_of(answer)
    assert get(public, "/", cookie).status == 200
    with join(public, list(cookie.items())) as client:
        send(client, **CAMERA)
        wait_for(lambda: public.visitors.count, "the client")
        number = next(iter(public.get_clients()), 0)
        assert public.visitors.may_control(number) is not view_only


@pytest.mark.parametrize(
    ("headers", "is_secure"),
    [
        ({}, False),
        ({"X-Forwarded-Proto": "http"}, False),
        ({"X-Forwarded-Proto": "https"}, True),
        ({"X-Forwarded-Proto": "https, http"}, True),
        ({"Forwarded": "for=192.0.2.7;proto=https"}, True),
        ({"Sec-Fetch-Site": "none"}, False),  # of this machine
        ({"Sec-Fetch-Site": "none", "Host": "192.0.2.7"}, True),
    ],
)
def test_behind_tls_a_cookie_is_sent_through_nothing_else(public: LocalServer, headers, is_secure):
    answer = get(public, query(public), headers)
    assert answer.status == 303 and ("Secure" in answer.headers["Set-Cookie"].split("; ")) is is_secure


def test_a_cookie_does_not_help_a_link_with_a_wrong_token_nor_another_server(public: LocalServer):
    cookie = cookie_of(get(public, query(public)))
    assert get(public, "/?token=guess", cookie).status == 401
    name, _, value = cookie["Cookie"].partition("=")
    assert get(public, "/", {"Cookie": f"{name}0={value}"}).status == 401
    assert get(public, "/", {"Cookie": f"{name}=x; {name}={value}"}).status == 401


def test_a_program_may_leave_the_token_in_the_query(public: LocalServer):
    with join(public, path=query(public)) as client:
        read_until(client, "/light/sun")


def test_a_foreign_page_gets_nothing_even_with_the_cookie(public: LocalServer):
    cookie = cookie_of(get(public, query(public)))
    with pytest.raises(InvalidStatus) as refusal:
        join(public, [*cookie.items(), ("Origin", "http://evil.example")])
    assert refusal.value.response.status_code == 403


def test_tokens_differ_between_roles_and_starts():
    values = {Tokens(1).query(role) for role in Role for _ in range(5)}
    assert len(values) == 10 and min(map(len, values)) >= 32 + len("/?token=")


@pytest.mark.parametrize("path", ["/?token=%ff", "/?token=\ud800", "/?" + "a=1&" * 50, "//[", "/?token=é"])
def test_a_strange_path_has_no_role(path):
    assert Tokens(1).role(path, Headers({"Cookie": "aero_viz_1=é; ;=;x"})) is None
