"""The first picture of a session, drawn by a client that answers as a page does."""

import threading
import time
from collections.abc import Iterator
from contextlib import closing

import msgspec
import pytest
import zstandard
from small_source import small_config, small_source
from websockets.exceptions import ConnectionClosed
from websockets.sync.connection import Connection

from aero_viz.cli.serving import play_when_drawn
from aero_viz.dashboard import Dashboard, LocalServer
from aero_viz.dashboard.first_picture import show_first_picture
from aero_viz.dashboard.viser_private import wait_until_drawn
from aero_viz.session import Session
from tests.dashboard.page_client import CAMERA, join, send, wait_for


@pytest.fixture
def session() -> Iterator[Session]:
    """A paused session with its first plan."""
    session = Session(small_source(), config=small_config())
    session.tick()
    session.start(play=False)
    yield session
    session.close()


def answer(client: Connection, heard: list[dict], *, until: threading.Event) -> None:
    """Note what a client is sent and answer requests, as a page does that draws nothing before `until` is set."""
    try:
        while True:
            data = client.recv()
            assert isinstance(data, bytes)
            size = int.from_bytes(data[8:16], "little")
            content = zstandard.ZstdDecompressor().decompress(data[16 : 16 + size])
            for message in msgspec.msgpack.decode(content)["messages"]:
                heard.append(message)
                if message["type"] == "LocalStorageGetItemRequestMessage":
                    if message["key"] == "aero-viz-drawn":
                        until.wait()
                    reply = {"value": None, "error": None, "request_uuid": message["request_uuid"]}
                    send(client, type="LocalStorageGetItemResponseMessage", **reply)
    except ConnectionClosed:
        pass


def requests(heard: list[dict]) -> int:
    """Return how often the server has asked whether the page has drawn."""
    return sum(message.get("key") == "aero-viz-drawn" for message in heard)


def names(heard: list[dict]) -> set[str]:
    """Return the names of the scene nodes that a client knows."""
    return {message["name"] for message in heard if "props" in message and "name" in message}


def test_the_points_and_rollouts_come_before_the_panels_and_the_flight(session: Session, server: LocalServer):
    heard: list[dict] = []
    drawing = threading.Event()
    with join(server) as client:
        send(client, **CAMERA)
        threading.Thread(target=answer, args=(client, heard), kwargs={"until": drawing}, daemon=True).start()
        wait_for(server.get_clients, "the visitor")
        drawn: list = []
        opening = threading.Thread(
            target=lambda: drawn.extend(show_first_picture(session, server, is_over=lambda: False)), daemon=True
        )
        opening.start()
        wait_for(lambda: "/rollouts/drone/all" in names(heard), "the rollouts")
        wait_for(lambda: requests(heard), "the request")
        assert "/cloud/points" in names(heard) and "/drone/body" not in names(heard)
        assert not drawn
        drawing.set()
        opening.join()
        assert [layer.name for layer in drawn] == ["cloud", "rollouts"]
        with closing(Dashboard(session, server=server, drawn=drawn)) as dashboard:
            assert [dashboard.layers[layer.name] for layer in drawn] == drawn
            wait_for(lambda: "/drone/body" in names(heard), "the other layers")
            assert not session.playing
            play_when_drawn(session, dashboard)
            wait_for(lambda: session.playing, "the flight")


@pytest.mark.parametrize("has_plan", [False, True])
def test_without_a_plan_or_a_visitor_the_first_picture_is_left_out(server: LocalServer, has_plan: bool):
    with closing(Session(small_source(), config=small_config())) as session:
        if has_plan:
            session.tick()
        layers = show_first_picture(session, server, is_over=lambda: True)
    assert [layer.name for layer in layers] == ["cloud", "rollouts"]


def test_a_visitor_who_leaves_ends_the_wait(server: LocalServer):
    with join(server) as client:
        send(client, **CAMERA)
        wait_for(server.get_clients, "the visitor")
        handle = next(iter(server.get_clients().values()))
    began = time.monotonic()
    wait_until_drawn(handle)
    assert time.monotonic() - began < 1.0


def test_a_visitor_who_steps_before_everything_is_drawn_goes_on_from_there(session: Session, server: LocalServer):
    heard: list[dict] = []
    drawing = threading.Event()
    with closing(Dashboard(session, server=server)) as dashboard, join(server) as client:
        send(client, **CAMERA)
        threading.Thread(target=answer, args=(client, heard), kwargs={"until": drawing}, daemon=True).start()
        play_when_drawn(session, dashboard)
        wait_for(lambda: requests(heard), "the request")
        session.step().result()
        drawing.set()
        wait_for(lambda: requests(heard) == 3, "all requests")
        time.sleep(0.2)
        assert not session.playing
