"""The simulator as a node: programs that speak only ROS 2 fly it, and are judged as planners are."""

from __future__ import annotations

import contextlib
import csv
import json
import re
import signal
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from command_line import run_json, run_refused

from aero_planner import VehicleState
from aero_planner.quaternions import quaternion_from_angles
from aero_viz.flight import FlightSource
from aero_viz.ros.commands import READERS, TOPICS, Following, Situation, along, timed
from aero_viz.ros.graph import Graph
from aero_viz.ros.simulator import RosConfig
from aero_viz.scenes import World
from aero_viz.session import Session
from tests.cli.programs import interrupt, read_line
from tests.dashboard.page_client import CAMERA, join, read_until, send
from tests.ros.conftest import Start, wait_until
from tests.ros.test_publishing import Peer

STAMPED = "geometry_msgs/msg/TwistStamped"
"""Type of the commands of the other tests; messages of mavros are not among the wheels."""
SIM = ("--ros", "--headless", "--seed", "1", "--rules.time-limit", "30")
NOW = Situation(
    2.0, VehicleState((0.0, 0.0, 2.0), (1.0, 0.0, 0.0), quaternion_from_angles(0.0, 10.0, 90.0)), Following(),
    RosConfig().vehicle,
)  # fmt: skip


@pytest.fixture
def open_world(tmp_path: Path) -> str:
    """File of a world without obstacles, with the goal 3 m away and the arrival 1 m before it."""
    (tmp_path / "worlds").mkdir()
    path = tmp_path / "worlds" / "open.json"
    World.from_dict({"name": "open", "start": [0, 0, 2], "goal": [2, 2.2, 2]}).save(path)
    return str(path)


def test_a_planner_that_speaks_only_ros_flies_the_forest(domain: int, capsys: pytest.CaptureFixture[str]):
    with subprocess.Popen([sys.executable, "examples/ros_planner.py"]) as planner:
        try:
            result = run_json(capsys, "sim", "forest", *SIM, "--speed", "3", "--goal", "20", "0", "2")
        finally:
            planner.send_signal(signal.SIGINT)
    assert (result["reason"], result["explanation"]) == ("arrived", None)
    assert result["min_clearance"] > 0.25 and 1.0 < result["mean_speed"] < 3.0 and result["length_m"] > 15.0


@pytest.mark.parametrize(
    "kind", [kind for kind in TOPICS.values() if kind != STAMPED and not kind.startswith("mavros")]
)
def test_every_command_that_is_installed_flies_the_drone(
    start: Start, capsys: pytest.CaptureFixture[str], open_world: str, kind: str
):
    start("tests.ros.commander", kind)
    assert run_json(capsys, "sim", open_world, *SIM)["reason"] == "arrived"


def test_the_drone_brakes_when_commands_stop(start: Start, capsys: pytest.CaptureFixture[str], open_world: str):
    start("tests.ros.commander", STAMPED, "0.7")
    result = run_json(capsys, "sim", open_world, *SIM, "--rules.stall-time", "2", "--ros.timeout", "0.2")
    assert result["reason"] == "stall" and result["end_speed"] < 0.1 < result["length_m"]


def test_a_benchmark_counts_its_flights(
    start: Start, capsys: pytest.CaptureFixture[str], open_world: str, tmp_path: Path
):
    start("tests.ros.commander", STAMPED)
    arguments = ("--planner", "ros", "--flights", "1", "--output", str(tmp_path / "out"), "--no-examine")
    run_json(capsys, "bench", "worlds", str(Path(open_world).parent), *arguments)
    with open(tmp_path / "out" / "flights.csv", newline="") as file:
        assert [row["reason"] for row in csv.DictReader(file)] == ["arrived"]


def test_the_page_shows_the_flight_and_its_result_is_printed(start: Start, open_world: str):
    start("tests.ros.commander", STAMPED)
    command = [sys.executable, "-m", "aero_viz", "sim", open_world, "--ros", "--json", "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        while not (address := re.search(r" at http://(\S+)", read_line(process))):
            assert process.poll() is None
        with join(url=f"ws://{address[1]}") as visitor:
            send(visitor, **CAMERA)  # the flight begins
            read_until(visitor, "arrived")
            assert json.loads(read_line(process))["reason"] == "arrived"
        interrupt(process)


def test_while_nobody_commands_the_drone_all_that_it_sees_is_published_and_then_it_says_what_is_missing(
    start: Start, capsys: pytest.CaptureFixture[str]
):
    peer, found = Peer(start("tests.ros.peer")), dict[str, Any]()
    read = ["/clock", "/goal_pose", "/odometry", "/points"]
    reader = threading.Thread(target=lambda: found.update(peer.ask(read=read)))
    reader.start()
    result = run_json(capsys, "sim", "forest", *SIM, "--ros.patience", "5")
    assert result["reason"] == "planner_failed" and "/cmd_vel" in result["explanation"]
    reader.join(60.0)
    assert found["/clock"]["clock"] == found["/odometry"]["header"]["stamp"] and found["/points"]["width"] > 1000
    assert found["/goal_pose"]["pose"]["position"]["x"] == pytest.approx(45.0)


def test_stamps_never_go_back_where_time_does(graph: Graph, start: Start, open_world: str):
    start("tests.ros.commander", STAMPED)
    stamps: list[int] = []
    graph.subscribe("/clock", "rosgraph_msgs/msg/Clock", lambda m: stamps.append(m.clock.sec * 10**9 + m.clock.nanosec))
    with contextlib.closing(Session(FlightSource(World.load(open_world)), config=RosConfig())) as session:
        while (frame := session.tick()).time < 0.4 or not stamps:  # it may take a while to find the publisher
            pass
        session.seek(0.1)
        before = len(stamps)
        again = [session.tick().time for _ in range(20)][-1]
        wait_until(lambda: len(stamps) > before + 10)
    assert frame.outcome is None and again == pytest.approx(0.5)
    assert stamps == sorted(stamps)


def test_sim_says_that_it_needs_ros(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    assert "add --ros" in run_refused(capsys, "sim", "forest")
    assert "add --ros" in run_refused(capsys, "sim", "forest", "--ros", "--planner", "primitives")
    assert "leave --ros-out out" in run_refused(capsys, "sim", "forest", "--ros", "--ros-out")
    monkeypatch.setitem(sys.modules, "rclpy", None)
    assert "'.[ros]'" in run_refused(capsys, "sim", "forest", "--ros")


def vector(*values: float) -> SimpleNamespace:
    return SimpleNamespace(**dict(zip("xyzw", values, strict=False)))


def target(mask: int, thrust: float) -> SimpleNamespace:
    """A mavros_msgs/AttitudeTarget, whose package is not among the wheels."""
    level = vector(0.0, 0.0, 0.0, 1.0)
    return SimpleNamespace(type_mask=mask, thrust=thrust, body_rate=vector(0.1, 0.2, 0.3), orientation=level)


def test_thrust_and_rates_of_mavros_are_those_of_the_drone():
    read = READERS["mavros_msgs/msg/AttitudeTarget"]
    model, control = read(target(128, 0.5), NOW, lambda stamp: None).control(NOW)
    assert model == "ctbr" and control == pytest.approx([9.81, 0.1, 0.2, 0.3])
    model, control = read(target(7, 0.75), NOW, lambda stamp: None).control(NOW)
    assert model == "acceleration" and control == pytest.approx([0.0, 0.0, 0.5 * 9.81, 0.0])
    with pytest.raises(ValueError, match="no thrust"):
        read(target(64, 0.5), NOW, lambda stamp: None)


@pytest.mark.parametrize(("frame", "expected"), [("world", [0.0, 0.0]), ("base_link", [-1.0, 1.0])])
def test_a_velocity_is_in_the_frame_of_its_header(frame: str, expected: list[float]):
    linear = vector(1.0, 0.0, 0.0)
    twist = SimpleNamespace(linear=linear, angular=vector(0.0, 0.0, 0.4))
    message = SimpleNamespace(twist=twist, header=SimpleNamespace(frame_id=frame))
    _, control = READERS["geometry_msgs/msg/TwistStamped"](message, NOW, lambda stamp: None).control(NOW)
    gain = Following().velocity_gain  # the nose points along y, 10 degrees down
    np.testing.assert_allclose(control[:2] / gain, expected, atol=0.02)
    assert control[3] == 0.4
    _, control = READERS["geometry_msgs/msg/Twist"](twist, NOW, lambda stamp: None).control(NOW)
    np.testing.assert_allclose(control[:3] / gain, [-1.0, 1.0, 0.0], atol=1e-6)


def test_a_trajectory_of_one_point_is_a_setpoint_that_moves_on():
    moving = SimpleNamespace(linear=vector(1.0, 0.0, 0.0))
    point = SimpleNamespace(
        transforms=[SimpleNamespace(translation=vector(1.0, 0.0, 2.0))], velocities=[moving], accelerations=[],
        time_from_start=SimpleNamespace(sec=0, nanosec=0),
    )  # fmt: skip
    message = SimpleNamespace(header=SimpleNamespace(stamp=None), points=[point])
    setpoint = READERS["trajectory_msgs/msg/MultiDOFJointTrajectory"](message, NOW, lambda stamp: None)
    _, control = setpoint.control(NOW)
    assert control == pytest.approx([Following().position_gain, 0.0, 0.0, 0.0])
    _, later = setpoint.control(replace(NOW, time=NOW.time + 0.25))
    assert later == pytest.approx([1.25 * Following().position_gain, 0.0, 0.0, 0.0])
    point.velocities = []
    assert READERS["trajectory_msgs/msg/MultiDOFJointTrajectory"](message, NOW, lambda stamp: None).path(
        NOW, np.array([0.0, 1.0])
    ) == pytest.approx(np.array([[1.0, 0.0, 2.0]] * 2))


def test_a_path_without_times_is_flown_at_the_speed_limit_and_stops_at_its_end():
    path = along([[-5.0, 0.0, 2.0], [5.0, 0.0, 2.0], [30.0, 0.0, 2.0]], NOW)
    speeds = np.linalg.norm(path.velocities, axis=1)
    assert path.times[0] == NOW.time and (np.diff(path.positions[:, 0]) > 0.0).all()
    assert speeds.max() == pytest.approx(7.0, rel=0.01) and speeds[-1] < 1.0
    assert np.abs(np.gradient(speeds[5:-2], path.times[5:-2])).max() < 1.2 * Following().braking


@pytest.mark.parametrize(("positions", "text"), [([[0, 0, np.nan]], "not finite"), (np.zeros((0, 3)), "no positions")])
def test_a_path_that_cannot_be_flown_is_refused(positions: Any, text: str):
    with pytest.raises(ValueError, match=text):
        along(positions, NOW)
    with pytest.raises(ValueError, match="times do not increase"):
        timed([1.0, 1.0], [[0, 0, 0], [1, 0, 0]])


def test_no_velocity_exceeds_the_limit():
    message = SimpleNamespace(linear=vector(100.0, 0.0, 0.0), angular=vector(0.0, 0.0, 0.0))
    setpoint = READERS["geometry_msgs/msg/Twist"](message, NOW, lambda stamp: None)
    assert np.linalg.norm(setpoint.path(NOW, np.array([1.0]))[0] - NOW.state.position) == pytest.approx(7.0)
