"""The live server for Foxglove, read by a WebSocket client as in Foxglove's protocol."""

import json
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
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

pytest.importorskip("foxglove", reason="the extra 'foxglove' is not installed")

TOPICS = {"/odometry", "/tf", "/sweep", "/goal", "/plan", "/plan/best"}


@pytest.fixture
def session() -> Iterator[Session]:
    source = FlightSource(scene("forest", seed=2, count=40), lidar=LidarModel("small", points_per_sweep=1000), seed=4)
    with closing(Session(source, config=PlannerConfig().replace({"sampling.samples": 8}), seed=4)) as session:
        yield session


@contextmanager
def client(url: str) -> Iterator[tuple[Connection, dict[str, Any]]]:
    """A client that has subscribed to all topics; the topics are the ids of the subscriptions."""
    with connect(url, subprotocols=["foxglove.sdk.v1"], max_size=None) as connection:  # type: ignore[list-item]
        channels: dict[str, Any] = {}
        while not channels.keys() >= TOPICS:
            message = json.loads(connection.recv(timeout=30))
            channels |= {channel["topic"]: channel for channel in message.get("channels", ())}
        time.sleep(0.5)  # the SDK announces a channel just before it accepts subscriptions to it
        wanted = [{"id": channel["id"], "channelId": channel["id"]} for channel in channels.values()]
        connection.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
        yield connection, {str(channel["id"]): channel for channel in channels.values()}


def read(connection: Connection, channels: dict[str, Any], topics: set[str]) -> dict[str, tuple[int, Any]]:
    """Return the first message of each topic with its stamp, decoded with the advertised definition."""
    found: dict[str, tuple[int, Any]] = {}
    while not found.keys() >= topics:
        data = connection.recv(timeout=30)
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


def test_a_client_that_joins_late_gets_the_last_messages(session: Session, tmp_path: Path):
    import foxglove

    session.tick()
    with foxglove.open_mcap(tmp_path / "other.mcap"), serve_foxglove(session, "127.0.0.1", 0) as server:
        for _ in range(2):
            with client(server.url) as (connection, channels):
                read(connection, channels, TOPICS)


def test_a_port_in_use_is_refused_with_its_number():
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(UserError, match=rf"port {port} of 127.0.0.1: .*in use"):
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


@pytest.mark.parametrize("verb", [("play",), ("demo", "pillars")])
def test_the_verbs_serve_while_the_page_waits_and_end_with_ctrl_c(verb: tuple[str, ...]):
    command = [sys.executable, "-m", "aero_viz", *verb, "--port", "0", "--foxglove", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            assert line.startswith("Foxglove: ws://127.0.0.1:")
            with client(line.split()[1]) as (connection, channels):
                read(connection, channels, TOPICS)
                process.send_signal(signal.SIGINT)
                _, error = process.communicate(timeout=60)
            assert process.returncode == 0 and "Traceback" not in error, error
        finally:
            process.kill()
