"""Strangers and watchers who open many connections, send large messages, or both."""

import contextlib
import resource
import socket
import subprocess
import sys
import time
from types import SimpleNamespace
from typing import Any

import psutil
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus

from aero_viz.dashboard.server import LocalServer
from aero_viz.guests import CLIENTS_MAX, Guests
from tests.dashboard.page_client import CAMERA, join, read_until, send, wait_for

HEADER = bytes([0x82, 0xFF])  # a binary message with a mask, whose size has eight bytes


def path(server: LocalServer, *, view_only: bool) -> str:
    return server.link(view_only=view_only).removeprefix(server.url)


def connect(server: LocalServer) -> socket.socket:
    return socket.create_connection(("127.0.0.1", server.get_port()), timeout=10.0)


def is_open(connection: socket.socket) -> bool:
    connection.setblocking(False)
    try:
        return connection.recv(1) != b""
    except BlockingIOError:
        return True
    except OSError:
        return False


def test_idle_connections_keep_nobody_out(public: LocalServer, caplog: pytest.LogCaptureFixture):
    with contextlib.ExitStack() as stack:
        idle = [stack.enter_context(connect(public)) for _ in range(150)]
        for connection in idle[::2]:
            with contextlib.suppress(OSError):
                connection.sendall(b"GET / HTTP/1.1\r\nHost: x\r\n")
        with join(public, path=path(public, view_only=False)) as client:
            read_until(client, "/light/sun")
        wait_for(lambda: sum(map(is_open, idle)) <= 24, "the end of the others")
    lines = [record for record in caplog.records if record.levelname == "WARNING"]
    assert len(lines) == 1 and "127.0.0.1 opens many connections" in lines[0].getMessage()


class Guest:
    """A connection without a network."""

    def __init__(self, address: str, ended: list[str] | None = None) -> None:
        self.address, self.has_right = address, False
        self.transport = SimpleNamespace(abort=lambda: None if ended is None else ended.append(address))


def test_whoever_floods_loses_connections_of_their_own():
    guests = Guests(files=200)
    ended: list[str] = []

    def guest(address: str) -> Any:
        return Guest(address, ended)

    quiet = [guest(f"10.0.0.{i}") for i in range(5)]
    for one in quiet:
        guests.enter(one)
    for _ in range(500):
        guests.enter(guest("6.6.6.6"))
    for i in range(500):
        guests.enter(guest(f"7.7.{i // 250}.{i % 250}"))
        guests.enter(guest("6.6.6.6"))
    assert "6.6.6.6" in ended
    assert guests.admit(quiet[0], has_right=False)


def test_places_are_kept_for_those_who_may_control():
    guests = Guests(files=1000)

    def guest(address: str) -> Any:
        one: Any = Guest(address)
        guests.enter(one)
        return one

    watching = [guests.admit(guest(f"10.0.0.{i % 10}"), has_right=False) for i in range(200)]
    assert guests.clients_max == CLIENTS_MAX and sum(watching) == CLIENTS_MAX - 8
    assert sum(guests.admit(guest("10.0.0.1"), has_right=True) for _ in range(20)) == 8


def test_few_files_leave_few_places_but_some():
    for files in (0, 80, 128, 200, 1024):
        guests = Guests(files=files)
        assert 0 < guests.waiting_max + guests.clients_max <= max(files - 64, 12)
        assert guests.waiting_max > 3 and guests.clients_max > 7


def test_the_link_for_watching_does_not_keep_the_controller_out(public: LocalServer):
    with contextlib.ExitStack() as stack:
        admitted = 0
        for _ in range(64):
            with contextlib.suppress(InvalidStatus):
                stack.enter_context(join(public, path=path(public, view_only=True)))
                admitted += 1
        assert admitted == 16  # from one address
        with join(public, path=path(public, view_only=False)) as client:
            send(client, **CAMERA)
            read_until(client, "/light/sun")


@pytest.mark.parametrize("view_only", [True, False])
def test_a_large_message_is_refused_by_its_first_bytes(public: LocalServer, view_only: bool):
    limit = 1 << 16 if view_only else 1 << 20
    for size in (limit + 1, 48 << 20, 1 << 62):
        with join(public, path=path(public, view_only=view_only)) as client:
            send(client, **CAMERA)
            client.socket.sendall(HEADER + size.to_bytes(8, "big") + b"mask")
            with pytest.raises(ConnectionClosed, match="1009"):
                while True:
                    client.recv(timeout=60.0)


def test_half_sent_messages_of_watchers_take_little_memory(public: LocalServer):
    before = psutil.Process().memory_info().rss
    with contextlib.ExitStack() as stack:
        for _ in range(16):
            client = stack.enter_context(join(public, path=path(public, view_only=True)))
            with contextlib.suppress(OSError):
                client.socket.sendall(HEADER + (49 << 20).to_bytes(8, "big") + b"mask")
                for _ in range(48):
                    client.socket.sendall(bytes(1 << 20))
        assert psutil.Process().memory_info().rss - before < 150e6


def test_a_picture_that_was_asked_for_may_be_large(public: LocalServer):
    with join(public, path=path(public, view_only=False)) as client:
        send(client, **CAMERA)
        wait_for(public.get_clients, "the client")
        (handle,) = public.get_clients().values()
        with public.rendering(handle):
            send(client, type="GetRenderResponseMessage", payload=bytes(3 << 20), render_uuid="absent")
            send(client, **CAMERA)
            read_until(client, "/light/sun")
        with pytest.raises(ConnectionClosed):
            send(client, type="GetRenderResponseMessage", payload=bytes(3 << 20), render_uuid="absent")
            while True:
                client.recv(timeout=60.0)


PROGRAM = """
import socket, sys, time
from aero_viz.dashboard.server import LocalServer
server = LocalServer(host="0.0.0.0", port=0)
print(server.get_port(), server.link(), flush=True)
sys.stdin.readline()
[open("/dev/null") for _ in range(20)]
print("alive", flush=True)
sys.stdin.readline()
"""


@pytest.mark.skipif(sys.platform != "linux", reason="counts the files of a process")
def test_a_program_with_few_files_lives_on_and_says_one_line():
    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (128, 128))

    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM], preexec_fn=limit, text=True,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    assert process.stdin is not None and process.stdout is not None
    try:
        port = int(process.stdout.readline().split()[0])
        with contextlib.ExitStack() as stack:
            end = time.monotonic() + 3.0
            while time.monotonic() < end:
                with contextlib.suppress(OSError):
                    connection = stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=1.0))
                    connection.sendall(b"GET / HTTP/1.1\r\n")
                time.sleep(0.002)
            process.stdin.write("\n")
            process.stdin.flush()
            assert process.stdout.readline() == "alive\n"
        _, error = process.communicate("\n", timeout=60.0)
    finally:
        process.kill()
    assert process.returncode == 0 and error.count("many connections") == 1 and len(error) < 1000, error
