"""The live server for Foxglove, read by a WebSocket client as in Foxglove's protocol."""

import json
import signal
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from websockets import Origin, Subprotocol
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.sync.connection import Connection

from aero_planner import PlannerConfig
from aero_viz.errors import UserError
from aero_viz.flight import FlightSource
from aero_viz.logs import flight_recorder, foxglove_recorder, serve_foxglove
from aero_viz.logs.foxglove_server import FoxgloveServer
from aero_viz.recordings import inspect
from aero_viz.scenes import scene
from aero_viz.sensors import LidarModel
from aero_viz.session import Session

TOPICS = {"/odometry", "/tf", "/sweep", "/goal", "/plan", "/plan/best"}


@pytest.fixture
def session() -> Iterator[Session]:
    source = FlightSource(scene("forest", seed=2, count=40), lidar=LidarModel("small", points_per_sweep=1000), seed=4)
    with closing(Session(source, config=PlannerConfig().replace({"sampling.samples": 8}), seed=4)) as session:
        yield session


@contextmanager
def client(
    url: str, *, protocol: str = "foxglove.sdk.v1", **options: Any
) -> Iterator[tuple[Connection, dict[str, Any]]]:
    """A client that has subscribed to all topics; the topics are the ids of the subscriptions."""
    options = {"max_size": None, "open_timeout": 60.0} | options
    with connect(url, subprotocols=[Subprotocol(protocol)], **options) as connection:
        channels: dict[str, Any] = {}
        while not channels.keys() >= TOPICS:
            message = json.loads(connection.recv(timeout=60))
            channels |= {channel["topic"]: channel for channel in message.get("channels", ())}
        wanted = [{"id": channel["id"], "channelId": channel["id"]} for channel in channels.values()]
        connection.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
        yield connection, {str(channel["id"]): channel for channel in channels.values()}


def read(connection: Connection, channels: dict[str, Any], topics: set[str]) -> dict[str, tuple[int, Any]]:
    """Return the first message of each topic with its stamp, decoded with the advertised definition."""
    found: dict[str, tuple[int, Any]] = {}
    while not found.keys() >= topics:
        data = connection.recv(timeout=60)
        if isinstance(data, str) or data[0] != 1:
            continue
        subscription, stamp = struct.unpack_from("<IQ", data, 1)
        channel = channels[str(subscription)]
        schema = Schema(
            id=subscription, data=channel["schema"].encode(), encoding="ros2msg", name=channel["schemaName"]
        )
        decode = DecoderFactory().decoder_for(channel["encoding"], schema)
        assert decode is not None
        found.setdefault(channel["topic"], (stamp, decode(data[13:])))
    return found


def test_a_client_reads_the_topics_of_the_flight_log_and_what_came_before(session: Session):
    frame = session.tick()
    with serve_foxglove(session, "127.0.0.1", 0) as server, client(server.url) as (connection, channels):
        found = read(connection, channels, TOPICS)  # nothing is flown: these are the last messages
        stamp, odometry = found["/odometry"]
        position, goal = odometry.pose.pose.position, np.asarray(frame.observation.goal.position)
        drone = np.asarray(frame.observation.actual_state.position)
        np.testing.assert_allclose((position.x, position.y, position.z), drone)
        assert found["/goal"][1].pose.position.x == pytest.approx(goal[0])
        assert found["/sweep"][1].width > 100
        for _ in range(3):
            frame = session.tick()
        assert read(connection, channels, {"/odometry", "/plan"})["/odometry"][0] > stamp


def test_every_client_gets_the_last_messages_whenever_it_joins(session: Session):
    session.tick()
    with serve_foxglove(session, "127.0.0.1", 0) as server, client(server.url) as first:
        read(*first, TOPICS)
        with client(server.url, protocol="foxglove.websocket.v1") as second:
            read(*second, TOPICS)


@pytest.mark.parametrize("origin", ["http://evil.example", "http://localhost:3000", "null", "https://foxglove.dev"])
def test_a_foreign_page_gets_nothing_and_is_named_once(session: Session, caplog: pytest.LogCaptureFixture, origin: str):
    session.tick()
    with serve_foxglove(session, "127.0.0.1", 0) as server:
        for _ in range(3):
            with pytest.raises(InvalidStatus) as refusal, client(server.url, origin=Origin(origin)):
                pass
            assert refusal.value.response.status_code == 403
    (line,) = caplog.messages
    assert origin in line and "--foxglove-origin" in line


@pytest.mark.parametrize("origin", ["https://app.foxglove.dev", "file://", "http://localhost:8080"])
def test_the_pages_of_foxglove_and_allowed_ones_get_the_flight(session: Session, origin: str):
    session.tick()
    with (
        serve_foxglove(session, "127.0.0.1", 0, allowed_origins=["http://localhost:8080"]) as server,
        client(server.url, origin=Origin(origin)) as (connection, channels),
    ):
        read(connection, channels, TOPICS)


def test_what_a_client_sends_changes_nothing(session: Session):
    session.tick()
    with serve_foxglove(session, "127.0.0.1", 0) as server, client(server.url) as (connection, channels):
        wrong = [{"id": 1 << 40, "channelId": 1}, {"id": "a"}, {"id": 9, "channelId": 99}, None]
        for message in (
            "x",
            "[]",
            "[" * 20000,
            b"\x01x",
            {"op": "advertise"},
            {"op": "subscribe", "subscriptions": wrong},
        ):
            connection.send(json.dumps(message) if isinstance(message, dict) else message)
        read(connection, channels, TOPICS)
        connection.send(json.dumps({"op": "unsubscribe", "subscriptionIds": [*map(int, channels), None, 77]}))
        session.tick()
        connection.ping().wait(60)
        session.tick()
        with pytest.raises(TimeoutError):
            while True:
                connection.recv(timeout=1)


def test_a_client_that_does_not_read_loses_messages_but_not_the_connection(session: Session):
    frame = session.tick()
    with closing(FoxgloveServer("127.0.0.1", 0)) as server:
        server.write(frame)
        with client(server.url) as (connection, channels):
            read(connection, channels, TOPICS)
            for _ in range(600):
                server.write(frame)
            with client(server.url) as other:  # is served meanwhile
                read(*other, TOPICS)
            count = 1 if connection.recv(timeout=60) else 0
            with pytest.raises(TimeoutError):
                while connection.recv(timeout=2):
                    count += 1
            assert 0 < count < 600 * len(TOPICS)


def test_a_port_in_use_is_refused_with_its_number():
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(UserError, match=rf"port {port} of 127.0.0.1: it is in use; give another one"):
            FoxgloveServer("127.0.0.1", port)


def test_a_recorder_serves_and_logs_the_same_flight(session: Session, tmp_path: Path):
    path, urls = tmp_path / "flight.mcap", []
    with foxglove_recorder("127.0.0.1", 0, log=flight_recorder(path), announce=urls.append) as recorder:
        for _ in range(2):
            frame = session.tick()
            recorder.write(frame)
            recorder.write_pose(frame.time + 0.01, frame.observation.actual_state)
        with client(*urls) as (connection, channels):
            read(connection, channels, TOPICS)
    counts = {topic["name"]: topic["count"] for topic in inspect(path).to_dict()["topics"]}
    assert counts["/plan"] == 2 and counts["/odometry"] == 4


@pytest.mark.parametrize("arguments", [("play",), ("demo", "pillars")])
def test_the_commands_play_for_a_client_without_a_page_and_end_with_ctrl_c(arguments: tuple[str, ...]):
    command = [sys.executable, "-m", "aero_viz", *arguments, "--port", "0", "--foxglove", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            page, foxglove = process.stdout.readline(), process.stdout.readline()
            assert " at http" in page and foxglove.startswith("Foxglove: ws://127.0.0.1:")
            with client(foxglove.split()[1]) as (connection, channels):
                first = read(connection, channels, TOPICS)["/odometry"][0]
                assert read(connection, channels, {"/odometry"})["/odometry"][0] > first
                process.send_signal(signal.SIGINT)
                _, error = process.communicate(timeout=60)
            assert process.returncode == 0 and "Traceback" not in error, error
        finally:
            process.kill()
