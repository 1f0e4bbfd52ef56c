"""Requests that are answered, by their headers."""

import pytest
from websockets import Headers

from aero_viz.errors import UserError
from aero_viz.web_access import Access

OWN = {"Host": "localhost:8080", "Origin": "http://localhost:8080"}


def refused(access: Access, headers: dict[str, str]) -> bool:
    return access.refusal(Headers(headers)) is not None


@pytest.mark.parametrize(
    "headers",
    [
        OWN,
        {"Host": "127.0.0.1:8080"},
        {"Host": "[::1]:8080", "Origin": "http://[::1]:8080"},
        {"Host": "localhost:8080", "Origin": "HTTP://LocalHost:8080"},
        {"Host": "LOCALHOST:9000", "Origin": "http://localhost:9000"},  # a forwarded port
        {"Host": "localhost", "Origin": "http://localhost:80"},
        {"Host": "localhost:8080", "Sec-Fetch-Site": "none", "Sec-Fetch-Mode": "navigate"},
        {
            "Host": "localhost:8080",
            "Sec-Fetch-Site": "cross-site",
            "Sec-Fetch-Mode": "navigate",
            "Sec-Fetch-Dest": "document",
        },
        {**OWN, "Sec-Fetch-Site": "same-origin", "Sec-Fetch-Mode": "websocket"},
    ],
)
def test_own_pages_programs_and_links_are_answered(headers):
    assert not refused(Access("127.0.0.1"), headers)


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"Host": ""},
        {"Host": "localhost:x"},
        {"Host": "[::1"},
        {"Host": "user@localhost"},
        {"Host": "localhost/evil.example"},
        {"Host": "localhost#evil.example"},
        {"Host": "evil.example:8080"},  # a foreign name that points at this machine
        {"Host": "evil.example:8080", "Origin": "http://evil.example:8080"},
        {"Host": "192.0.2.7:8080"},
        {"Host": "localhost.evil.example"},
        {**OWN, "Origin": "http://evil.example"},
        {**OWN, "Origin": "http://localhost:3000"},  # another server on this machine
        {**OWN, "Origin": "http://127.0.0.1:8080"},
        {**OWN, "Origin": "https://localhost:443"},
        {**OWN, "Origin": "http://localhost"},  # port 80
        {**OWN, "Origin": "http://localhost:8080/evil"},
        {**OWN, "Origin": "null"},  # a sandboxed frame or a file
        {**OWN, "Origin": ""},
        {**OWN, "Origin": "chrome-extension://localhost:8080"},
        {**OWN, "Origin": "http://localhost:8080@evil.example"},
        {"Host": "localhost:8080", "Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "no-cors"},
        {"Host": "localhost:8080", "Sec-Fetch-Site": "same-site", "Sec-Fetch-Mode": "websocket"},
        {
            "Host": "localhost:8080",
            "Sec-Fetch-Site": "cross-site",
            "Sec-Fetch-Mode": "navigate",
            "Sec-Fetch-Dest": "iframe",
        },
    ],
)
def test_foreign_names_and_pages_are_refused(headers):
    assert refused(Access("127.0.0.1"), headers)


FRAME = {
    "Host": "localhost:8080",
    "Sec-Fetch-Site": "cross-site",
    "Sec-Fetch-Mode": "navigate",
    "Sec-Fetch-Dest": "iframe",
}


@pytest.mark.parametrize(
    ("origin", "written"),
    [
        ("http://localhost:8888", "http://localhost:8888"),
        ("HTTPS://Hub.Example.org", "https://hub.example.org"),
        ("http://[::1]:8888", "http://[::1]:8888"),
    ],
)
def test_a_page_may_show_ours_in_a_frame_if_it_was_named(origin: str, written: str):
    access = Access("127.0.0.1", embedders=[origin])
    assert access.security_headers["Content-Security-Policy"].endswith(f"; frame-ancestors {written}")
    assert "X-Frame-Options" not in access.security_headers and not refused(access, FRAME)
    assert refused(access, {**FRAME, "Sec-Fetch-Dest": "embed"})
    assert refused(access, {**OWN, "Origin": origin}), "it reads nothing"


def test_no_page_may_show_ours_in_a_frame_otherwise():
    access = Access("127.0.0.1", allowed_origins=["http://localhost:8888"])
    assert access.security_headers["Content-Security-Policy"].endswith("; frame-ancestors 'none'")
    assert access.security_headers["X-Frame-Options"] == "DENY" and refused(access, FRAME)


@pytest.mark.parametrize(
    "origin", ["", "*", "localhost:8888", "http://*", "file://", "http://a;b", "http://a b", "http://a/x"]
)
def test_what_is_no_origin_of_a_page_cannot_embed(origin: str):
    with pytest.raises(UserError, match="is not the origin"):
        Access("127.0.0.1", embedders=[origin])


def test_a_header_that_is_given_twice_is_refused():
    headers = Headers(OWN)
    headers["Origin"] = "http://evil.example"
    assert Access("127.0.0.1").refusal(headers)


def test_a_server_for_the_network_is_reached_by_address_but_not_by_a_foreign_name():
    access = Access("0.0.0.0")
    assert not refused(access, {"Host": "192.0.2.7:8080", "Origin": "http://192.0.2.7:8080"})
    assert refused(access, {"Host": "192.0.2.7:8080", "Origin": "http://198.51.100.1:8080"})
    assert refused(access, {"Host": "evil.example:8080", "Origin": "http://evil.example:8080"})


def test_an_address_may_be_written_in_other_ways_than_browsers_do():
    access = Access("FD00:0::0001")
    assert not refused(access, {"Host": "[fd00::1]:8080", "Origin": "http://[fd00::1]:8080"})
    assert refused(access, {"Host": "[fd00::2]:8080"})


@pytest.mark.parametrize(
    ("host", "is_local"),
    [
        ("127.0.0.1", True), ("127.0.0.2", True), ("::1", True), ("0:0::1", True), ("localhost", True),
        ("0.0.0.0", False), ("::", False), ("", False), ("192.0.2.7", False), ("drone.local", False),
    ],
)  # fmt: skip
def test_only_a_loopback_address_is_local(host, is_local):
    assert Access(host).is_local is is_local


def test_an_allowed_proxy_may_rewrite_the_host():
    access = Access("127.0.0.1", ["viz.example.org", "2001:db8::1"])
    for host in ("viz.example.org", "127.0.0.1:8080"):
        assert not refused(access, {"Host": host, "Origin": "https://viz.example.org"})
    assert refused(access, {"Host": "viz.example.org", "Origin": "https://evil.example"})
    assert not refused(access, {"Host": "[2001:db8::1]:80"})


@pytest.mark.parametrize("name", ["", "http://viz.example.org", "viz.example.org:80", "a/b", "[::1"])
def test_an_allowed_host_is_a_bare_name(name):
    with pytest.raises(UserError, match="--allow-host"):
        Access("127.0.0.1", [name])


def test_the_page_of_an_allowed_origin_is_answered_and_no_other_one():
    access = Access("127.0.0.1", (), ["https://app.foxglove.dev", "http://localhost:80", "file://", "App://bundle"])
    host = {"Host": "localhost:8765", "Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "websocket"}
    own = ("https://app.foxglove.dev", "HTTPS://app.foxglove.dev:443", "http://localhost", "file://", "app://bundle")
    for origin in own:
        assert not refused(access, {**host, "Origin": origin}), origin
    assert refused(access, {"Host": "evil.example:8765", "Origin": "https://app.foxglove.dev"})
    foreign = (
        "http://app.foxglove.dev",
        "https://app.foxglove.dev:444",
        "https://evil.app.foxglove.dev",
        "null",
        "file:",
    )
    for origin in (*foreign, "file:///", "https://app.foxglove.dev.evil.example", "app://", "://app.foxglove.dev"):
        assert refused(access, {**host, "Origin": origin}), origin


@pytest.mark.parametrize("origin", ["", "null", "*", "https://*", "https://*.dev", "app.foxglove.dev", "https://a/b"])
def test_an_allowed_origin_is_one_origin(origin):
    with pytest.raises(UserError, match="is not the origin of a page"):
        Access("127.0.0.1", (), [origin])
