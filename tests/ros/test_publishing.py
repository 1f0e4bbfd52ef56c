"""Frames and parameters in the graph of ROS 2, as another program sees them."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import numpy as np
import pytest
from command_line import run_json, run_refused
from diagnostic_msgs.msg import DiagnosticStatus
from small_source import small_config, small_source
from straight import StraightConfig

from aero_viz.ros.messages import diagnostics
from aero_viz.ros.publishing import publish_session
from aero_viz.session import Session
from tests.live.test_command import RECORDING
from tests.ros.conftest import Start, wait_until
from tests.session.test_drone_tuning import Drone, Pilot

TOPICS = {"/odometry", "/goal", "/plan/best", "/plan/candidates", "/command/velocity", "/command/acceleration"}
CELLS = {"/sweep", "/plan/guides", "/plan/cells", "/plan/filtered"}
SHARED = {"/diagnostics"}
"""Topics that are not in the namespace /aero_viz."""


any_planner = pytest.mark.parametrize(
    "session", [small_config(), StraightConfig()], ids=["aero_mppi", "straight"], indirect=True
)


class Peer:
    """The other program, `tests.ros.peer`."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def read(self, topics: set[str]) -> dict[str, Any]:
        """Return the next message of each topic."""
        names = {topic if topic in SHARED else f"/aero_viz{topic}": topic for topic in topics}
        return {names[name]: message for name, message in self.ask(read=sorted(names)).items()}

    def ask(self, **request: Any) -> Any:
        """Return the answer to a request."""
        assert self._process.stdin is not None and self._process.stdout is not None
        print(json.dumps(request), file=self._process.stdin, flush=True)
        return json.loads(self._process.stdout.readline())


@pytest.fixture
def peer(start: Start) -> Peer:
    return Peer(start("tests.ros.peer"))


@pytest.fixture
def session(request: pytest.FixtureRequest, domain: int) -> Iterator[Session]:
    """A flight that ticks only when it is told, published; of the planner `Straight` unless a test asks for others."""
    with closing(Session(small_source(), config=getattr(request, "param", StraightConfig()), seed=1)) as session:
        session.tick()
        with publish_session(session):
            yield session


def played(session: Session, peer: Peer, topics: set[str]) -> dict[str, Any]:
    """Return what another program reads while the session is played."""
    found: dict[str, Any] = {}
    reader = threading.Thread(target=lambda: found.update(peer.read(topics)))
    reader.start()

    def is_over() -> bool:
        if session.tick().time > 0.5:  # before a flight ends
            session.seek(0.0)
        return not reader.is_alive()

    wait_until(is_over, timeout=60.0)
    return found


@any_planner
def test_another_program_reads_the_plan_its_costs_and_its_command(session: Session, peer: Peer):
    frame = session.tick()
    plan, is_ensemble = frame.plan, "cells" in frame.plan.extensions
    found = played(session, peer, TOPICS | SHARED | (CELLS if is_ensemble else set()))
    assert len(found["/plan/best"]["poses"]) == plan.positions.shape[1]
    lines, texts = found["/plan/candidates"]["markers"][::2], found["/plan/candidates"]["markers"][1::2]
    assert [len(line["points"]) for line in lines] == [plan.positions.shape[1]] * len(plan.kinds)
    assert all(all(f"{term} " in text["text"] for term in plan.costs) for text in texts)
    (status,) = found["/diagnostics"]["status"]
    assert (status["message"], status["level"]) == ("safe", [0]) and status["hardware_id"] == "poles"
    values = {value["key"]: value["value"] for value in status["values"]}
    assert {f"cost of {term}" for term in plan.costs} <= values.keys() and float(values["speed [m/s]"]) >= 0.0
    position = found["/odometry"]["pose"]["pose"]["position"]
    assert np.linalg.norm([position["x"], position["y"], position["z"] - 2.0]) < 4.0
    assert found["/goal"]["pose"]["position"]["x"] == 12.0
    assert found["/command/velocity"]["twist"]["linear"]["x"] != 0.0
    assert found["/command/acceleration"]["accel"]["linear"]["x"] != 0.0
    if is_ensemble:
        assert found["/plan/cells"]["fields"] == ["x", "y", "z", "range", "continued"]
        assert found["/plan/cells"]["frame"] == "body" and found["/plan/filtered"]["frame"] == "world"
        assert found["/plan/cells"]["width"] == found["/plan/filtered"]["width"] > 100 < found["/sweep"]["width"]


def test_a_flight_that_fails_is_an_error(session: Session):
    while (frame := session.tick()).outcome is None:
        pass
    (status,) = diagnostics(frame, 0).status
    assert (status.level == DiagnosticStatus.ERROR) == (frame.outcome != "arrived") and "poles: " in status.message


@any_planner
def test_parameters_are_described_from_the_table(session: Session, peer: Peer):
    infos = session.config.parameters()
    described = {one["name"]: one for one in peer.ask(describe=[info.path for info in infos])}
    for info in infos:
        one = described[info.path]
        assert info.help in one["description"] and info.title in one["description"]
        assert one["additional_constraints"] == info.range
        limits = one["floating_point_range"] + one["integer_range"]
        assert [(limit["from_value"], limit["to_value"]) for limit in limits] == (
            [(info.low, info.high)] if info.is_number else []
        )
    assert peer.ask(get=[info.path for info in infos]) == [session.config.get(info.path) for info in infos]


def test_another_program_moves_the_sliders_and_the_other_way_round(session: Session, peer: Peer):
    assert peer.ask(set={"vehicle.mass": 1.5, "vehicle.speed_limit": 3}) == ["", ""]
    assert (session.config.vehicle.mass, session.config.vehicle.speed_limit) == (1.5, 3.0)
    assert session.frame is not None and session.frame.config == session.config  # the present tick is planned again
    session.undo()
    session.configure({"vehicle.rate_lag": 0.25})
    wait_until(lambda: peer.ask(get=["vehicle.speed_limit", "vehicle.rate_lag"]) == [7.0, 0.25])
    assert peer.ask(get=["vehicle.mass"]) == [1.5]


def test_a_value_that_is_refused_says_why_and_changes_nothing(session: Session, peer: Peer):
    before = session.config
    values = {"vehicle.mass": 1e6, "vehicle.model": "plane", "vehicle.thrust_min": 400.0, "vehicle.gravity": "low"}
    reasons = peer.ask(set=values)
    texts = ("50", "must be one of ctbr, acceleration", "must be less than vehicle.thrust_max", "must be a number in")
    for reason, text in zip(reasons, texts, strict=True):
        assert text in reason
    assert session.config == before
    assert peer.ask(get=list(values)) == [before.get(path) for path in values]


def test_another_planner_brings_its_own_parameters(session: Session, peer: Peer):
    session.configure(small_config())
    wait_until(lambda: peer.ask(describe=["costs.q_track"]))
    assert peer.ask(set={"costs.q_track": 8.0, "line.gain": 1.0})[0] == "" and peer.ask(describe=["line.gain"]) == []


def test_the_parameters_of_a_drone_that_is_shown_are_set_on_the_drone(domain: int, peer: Peer):
    with closing(Drone()) as drone, closing(Pilot(drone.telemetry.port)) as pilot, publish_session(pilot.session):
        assert peer.ask(get=["vehicle.speed_limit"]) == [5.0]
        assert "its parameters are set on the drone" in peer.ask(set={"vehicle.speed_limit": 3.0})[0]
        assert peer.ask(get=["vehicle.speed_limit"]) == [5.0]


def test_a_flight_without_a_page_is_published_and_stays_the_same(
    peer: Peer, capsys: pytest.CaptureFixture[str], tmp_path: Any
):
    world, arguments = tmp_path / "poles.json", ("--planner", "primitives", "--seed", "1")
    small_source(goal=5.0).info.world.save(world)  # type: ignore[union-attr]
    found: dict[str, Any] = {}
    reader = threading.Thread(target=lambda: found.update(peer.read(TOPICS)))
    reader.start()
    published: Any = None
    for _ in range(5):  # the flight may be over before the other program has found its topics
        published = run_json(capsys, "fly", str(world), *arguments, "--ros-out")
        reader.join(3.0)
        if not reader.is_alive():
            break
    plain = run_json(capsys, "fly", str(world), *arguments)
    assert {**published, "plan_ms_median": 0} == {**plain, "plan_ms_median": 0} and found.keys() == TOPICS


@pytest.mark.parametrize(
    "command", [("fly", "forest"), ("demo",), ("play", RECORDING), ("live", "--pcap-replay", RECORDING)]
)
def test_without_ros_the_flag_says_what_to_install(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, command: tuple[str, ...]
):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    said = run_refused(capsys, *command, "--ros-out")
    assert "'.[ros]'" in said and said.count("\n") <= 1
