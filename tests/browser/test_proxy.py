"""The page behind a proxy at a subpath, through https and wss, by the recipes of docs/security.md."""

from __future__ import annotations

import os
import re
import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Browser, Page

from aero_viz.browser import CHROMIUM_FLAGS, find_chromium
from aero_viz.dashboard import LocalServer
from tests.browser.desk import TIMEOUT

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "security.md"
NAME = "viz.example.org"
OVERALL = """
daemon off; master_process off; pid nginx.pid; error_log error.log;
events {}
http {
  access_log off;
  client_body_temp_path body; proxy_temp_path proxy; fastcgi_temp_path a; uwsgi_temp_path b; scgi_temp_path c;
  RECIPE
}
"""
Proxied = Callable[[str, LocalServer], str]
"""Starts a proxy with a configuration before a server; returns the address of the page."""


def recipe(language: str) -> str:
    """Return the block of the document in a language."""
    found = re.search(rf"```{language}\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)
    assert found, f"{DOCUMENT} has no block ```{language}"
    return found[1]


def program(name: str) -> str:
    """Return the path of a program that scripts/setup installs."""
    found = shutil.which(name, path=f"{os.environ['PATH']}:/usr/sbin")
    if found is None:
        message = f"{name} is missing, the page behind it was not tested: run `scripts/setup dev`"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    return found


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A certificate that nobody has signed, and its key."""
    folder = tmp_path_factory.mktemp("tls")
    files = folder / "viz.pem", folder / "viz.key"
    subject = ["-subj", f"/CN={NAME}", "-addext", f"subjectAltName=DNS:{NAME}", "-days", "2"]
    kind = ["-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]
    command = [program("openssl"), "req", *kind, *subject, "-out", str(files[0]), "-keyout", str(files[1])]
    subprocess.run(command, check=True, capture_output=True)
    return files


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return probe.getsockname()[1]


@pytest.fixture
def proxied(tmp_path: Path, certificate: tuple[Path, Path]) -> Iterator[Proxied]:
    running: list[subprocess.Popen[bytes]] = []

    def start(configuration: str, server: LocalServer) -> str:
        port = free_port()
        text = configuration.replace("127.0.0.1:8080", f"127.0.0.1:{server.get_port()}")
        text = text.replace("/etc/ssl/viz.pem", str(certificate[0])).replace("/etc/ssl/viz.key", str(certificate[1]))
        if "proxy_pass" in text:
            (tmp_path / "nginx.conf").write_text(OVERALL.replace("RECIPE", text.replace("443", f"127.0.0.1:{port}")))
            command = [program("nginx"), "-p", str(tmp_path), "-c", "nginx.conf", "-e", "error.log"]
        else:
            options = f"{{\n admin off\n auto_https off\n storage file_system {tmp_path}\n}}\n"
            text = text.replace(f"{NAME} {{", f"https://{NAME}:{port} {{\n bind 127.0.0.1\n")
            (tmp_path / "Caddyfile").write_text(options + text)
            command = [program("caddy"), "run", "--adapter", "caddyfile", "--config", str(tmp_path / "Caddyfile")]
        running.append(subprocess.Popen(command, cwd=tmp_path, stderr=(tmp_path / "log").open("wb")))
        deadline = time.monotonic() + TIMEOUT
        while socket.socket().connect_ex(("127.0.0.1", port)):
            assert running[-1].poll() is None and time.monotonic() < deadline, (tmp_path / "log").read_text()
            time.sleep(0.02)
        return f"https://{NAME}:{port}/flights"

    yield start
    for process in running:
        process.terminate()
        process.wait()


@pytest.fixture(scope="module")
def worldwide(browser: Browser) -> Iterator[Browser]:
    """A browser that finds the name of the proxy on this machine."""
    flags = [*CHROMIUM_FLAGS, f"--host-resolver-rules=MAP {NAME} 127.0.0.1"]
    chromium = browser.browser_type.launch(executable_path=find_chromium(), args=flags)
    yield chromium
    chromium.close()


@pytest.fixture
def page(worldwide: Browser) -> Iterator[Page]:
    context = worldwide.new_context(ignore_https_errors=True)
    context.set_default_timeout(1e3 * TIMEOUT)
    yield context.new_page()
    context.close()


def serve(**options: object) -> tuple[LocalServer, threading.Event]:
    """Return a server whose page has a button, and the event that the button sets."""
    server, pressed = LocalServer(port=0, **options), threading.Event()  # type: ignore[arg-type]
    server.gui.add_button("Take off").on_click(lambda _: pressed.set())
    return server, pressed


@pytest.mark.parametrize("language", ["nginx", "caddy"])
def test_the_page_works_behind_a_proxy_by_the_recipe(page: Page, proxied: Proxied, language: str):
    server, pressed = serve(allowed_hosts=[NAME])
    text = recipe(language)
    if language == "caddy":  # nobody outside can sign a certificate for a test
        text = text.replace(f"{NAME} {{", f"{NAME} {{\n tls /etc/ssl/viz.pem /etc/ssl/viz.key\n")
    address = proxied(text, server)
    sockets: list[str] = []
    page.on("websocket", lambda socket: sockets.append(socket.url))
    page.goto(server.link(address=address))
    page.get_by_role("button", name="Take off").click()
    assert pressed.wait(TIMEOUT)
    assert "token" not in page.url and page.url.startswith(address)
    assert set(sockets) == {address.replace("https", "wss")}
    (cookie,) = page.context.cookies()
    assert cookie.get("secure") and cookie.get("httpOnly")
    for again in (f"{address}/", page.url):  # a bookmark with a slash at the end, and the address as viser leaves it
        pressed.clear()
        page.goto(again)
        page.get_by_role("button", name="Take off").click()
        assert pressed.wait(TIMEOUT)
    server.stop()


@pytest.mark.parametrize(
    ("hosts", "change", "words"),
    [
        ([NAME], ("Host $http_host", "Host a.internal"), ("'a.internal'", "proxy_set_header Host $http_host")),
        ([], ("", ""), (f"'{NAME}'", f"--allow-host {NAME}")),
        # nginx asks for 127.0.0.1 if nothing is said: only the page knows what is in the address bar.
        ([], ("proxy_set_header Host $http_host;", ""), (f"https://{NAME}", f"--allow-host {NAME}")),
        (
            [NAME],
            ("Host $http_host;", "Host $http_host; proxy_set_header Origin http://flights.internal;"),
            ("http://flights.internal", "Remove proxy_set_header Origin"),
        ),
    ],
    ids=["host", "unnamed", "default", "origin"],
)  # fmt: skip
def test_a_page_explains_what_the_proxy_gets_wrong(page: Page, proxied: Proxied, hosts, change, words):
    server, pressed = serve(allowed_hosts=hosts)
    address = proxied(recipe("nginx").replace(*change), server)
    page.goto(server.link(address=address))
    page.get_by_role("heading", name="AERO-Viz does not answer this address").wait_for()
    text = page.locator("body").inner_text()
    assert all(word in text for word in words), text
    assert not pressed.is_set() and urlsplit(page.url).hostname == NAME
    server.stop()
