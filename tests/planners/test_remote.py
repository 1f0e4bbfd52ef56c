"""Planners in other processes: a real process with the client that ships, and peers that misbehave."""

import json
import os
import shutil
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from small_source import small_source, wait_for

from aero_viz.errors import UserError
from aero_viz.explain.post_mortem import explain_flight
from aero_viz.explain.trace import FlightTrace
from aero_viz.flight import FlightRules, fly
from aero_viz.planners import load
from aero_viz.scenes import World
from aero_viz.session import Session

CLIENTS = Path(__file__).parents[2] / "clients"
PROGRAM = """
import os, sys, time
sys.path.insert(0, sys.argv[1])
import aero_viz_planner

def plan(request):
    count = (request.history or 0) + 1
    if count == 8 and sys.argv[3] == "raise":
        raise RuntimeError("out of ideas")
    if count == 8 and sys.argv[3] == "hang":
        time.sleep(60.0)
    if count == 8 and sys.argv[3] == "crash":
        os._exit(3)
    assert len(request.points) % 3 == 0 and request.config["vehicle.speed_limit"] > 0
    speed = request.config["pace"]
    away = [g - p for g, p in zip(request.goal, request.position)]
    size = max(sum(x * x for x in away) ** 0.5, 1e-9)
    v = [speed * min(1.0, size / speed) * x / size for x in away]
    path = [[p + 0.1 * i * x for p, x in zip(request.position, v)] for i in range(11)]
    controls = [[2.0 * (x - y) for x, y in zip(v, request.velocity)] + [0.0]] * 10
    costs = {"goal": [size]}
    return {"positions": [path], "costs": costs, "best": 0, "step": 0.1, "controls": controls, "history": count}

pace = {"name": "pace", "default": 2.0, "low": 0.5, "high": 5.0, "unit": "m/s", "help": "Speed."}
aero_viz_planner.serve(sys.argv[2], plan, parameters=[pace], name="test")
"""


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., str]]:
    """Return a function that starts a planner in a process of its own and returns its name."""
    running: list[subprocess.Popen[str]] = []

    def start(fault: str = "") -> str:
        address = str(tmp_path / f"planner{len(running)}.sock")
        command = [sys.executable, "-c", PROGRAM, str(CLIENTS), address, fault]
        process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        running.append(process)
        assert process.stderr is not None and "listens at" in process.stderr.readline()
        return f"connect:{address}"

    yield start
    for process in running:
        process.kill()
        process.wait()


CPP = """
#include "aero_viz_planner.hpp"

aero_viz::Reply plan(const aero_viz::Request& request) {
    if (request.history == 7.0 && std::getenv("FAULT")) throw std::runtime_error("out of \\"ideas\\"");
    double size = 1e-9, speed = request.config.at("pace");
    for (int i = 0; i < 3; ++i) size = std::hypot(size, request.goal[i] - request.position[i]);
    aero_viz::Reply reply;
    reply.paths.resize(1);
    std::array<double, 4> control{};
    for (int i = 0; i < 3; ++i)
        control[i] = 2.0 * (speed * std::min(1.0, size / speed) * (request.goal[i] - request.position[i]) / size
                            - request.velocity[i]);
    for (int step = 0; step < 11; ++step) {
        aero_viz::Vector place = request.position;
        for (int i = 0; i < 3; ++i) place[i] += 0.1 * step * request.velocity[i];
        reply.paths[0].push_back(place);
    }
    reply.controls.assign(10, control);
    reply.costs["goal"] = {size};
    reply.history = request.history + 1.0;
    return reply;
}

int main(int, char** argv) { aero_viz::serve(argv[1], plan, {{"pace", 2.0, 0.5, 5.0, "m/s", "Speed."}}, "c++"); }
"""


@pytest.fixture(scope="module")
def cpp(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A planner in C++, compiled with the client that ships."""
    if shutil.which("c++") is None:
        message = "the C++ client was not tested: c++ not found; install a C++ compiler"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    folder = tmp_path_factory.mktemp("cpp")
    (folder / "planner.cpp").write_text(f"#include <algorithm>\n{CPP}")
    command = ["c++", "-std=c++17", "-Wall", "-Wextra", "-Werror", "-I", str(CLIENTS), "planner.cpp", "-o", "planner"]
    subprocess.run([*command, "-pthread"], cwd=folder, check=True)
    return folder / "planner"


@pytest.mark.parametrize("fault", [False, True])
def test_a_planner_in_c_plus_plus_flies(cpp: Path, tmp_path: Path, world: World, fault: bool):
    address = str(tmp_path / "planner.sock")
    environment = {**os.environ, **({"FAULT": "1"} if fault else {})}
    with subprocess.Popen([str(cpp), address], stderr=subprocess.PIPE, text=True, env=environment) as process:
        try:
            assert process.stderr is not None and "planner c++ listens at" in process.stderr.readline()
            config = load(f"connect:{address}").Config().replace({"remote.pace": 3.0})
            result = fly(world, config=config)
            if fault:
                assert result.reason == "planner_failed" and str(result.explanation).endswith('out of "ideas"')
            else:
                assert result.arrived and 2.0 < result.max_speed < 3.3
        finally:
            process.kill()


@pytest.fixture
def world() -> World:
    return World.from_dict({"name": "empty", "start": [0, 0, 2], "goal": [6, 0, 2]})


def test_a_planner_in_another_process_flies_and_its_parameters_are_known(start: Callable[..., str], world: World):
    kind = load(start()).Config
    assert kind.find("remote.pace").title == "Pace [m/s]" and kind().get("remote.pace") == 2.0
    slow, fast = (fly(world, config=kind().replace({"remote.pace": pace})) for pace in (1.5, 3.0))
    assert slow.arrived and fast.arrived and slow.flight_time_s > 1.3 * fast.flight_time_s
    session = Session(small_source(), config=kind())
    frames = [session.tick() for _ in range(5)]
    session.seek(frames[2].time).result()
    assert session.frame is not None and np.array_equal(session.frame.plan.command, frames[2].plan.command)
    session.close()


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        ("raise", "RuntimeError: out of ideas"),
        ("crash", "closed the connection"),
        ("hang", "it did not answer within 0.5 s"),
    ],
)
def test_a_failure_ends_the_flight_with_its_reason_and_not_the_session(
    start: Callable[..., str], world: World, fault: str, reason: str
):
    kind = load(start(fault))
    kind.timeout = 0.5 if fault == "hang" else 60.0  # type: ignore[attr-defined]
    config = kind.Config()
    result = fly(world, config=config)
    assert not result.arrived and result.reason == "planner_failed" and reason in str(result.explanation)
    if fault != "raise":
        return
    session = Session(small_source(), config=config)
    notices: list[str] = []
    session.subscribe_notices(lambda notice: notices.append(notice.text))
    frame = session.tick()
    while frame.outcome is None:
        frame = session.tick()
    assert frame.outcome == "planner_failed" and reason in str(frame.explanation)
    trace = FlightTrace()
    trace.write(frame)
    report, _ = explain_flight(trace)
    assert report.cause == "the planner failed" and reason in report.sentences[0]
    assert session.tick() is frame, "the flight is over"
    wait_for(lambda: notices)
    session.seek(0.0).result()
    assert session.frame is not None and session.frame.outcome is None, "the session goes on"
    session.close()


def answers(listener: socket.socket, after_hello: bytes, parameters: list[dict[str, object]]) -> None:
    """Say hello to each connection, and send `after_hello` in place of a plan."""
    hello = json.dumps({"type": "hello", "version": 1, "name": "bad", "parameters": parameters}).encode()
    while True:
        try:
            connection, _ = listener.accept()
        except OSError:
            return
        head = connection.recv(8, socket.MSG_WAITALL)
        text, _ = struct.unpack("<II", head)
        if b"hello" in connection.recv(text, socket.MSG_WAITALL):
            connection.sendall(struct.pack("<II", len(hello), 0) + hello)
        else:
            connection.sendall(after_hello)


def message(header: object, numbers: bytes = b"") -> bytes:
    text = json.dumps(header).encode()
    return struct.pack("<II", len(text), len(numbers)) + text + numbers


@pytest.mark.parametrize(
    ("garbage", "reason"),
    [
        (b"HTTP/1.1 200 OK\r\n\r\n", "bytes, which is no message"),
        (struct.pack("<II", 3, 0) + b"{{{", "something else than a message"),
        (message([1, 2]), "something else than a JSON object"),
        (message({"type": "plan"}), "it sent a plan that is none: KeyError.'shape'"),
        (message({"type": "plan", "shape": [1, 3, 3], "costs": {}, "best": 0, "step": 1}, b"\0" * 8), "2 numbers for"),
        (
            message({"type": "plan", "shape": [1, 3, 3], "costs": {"a": 7}, "best": 0, "step": 1}, b"\0" * 36),
            r"costs\[",
        ),
        (message({"type": "plan", "shape": [1, 2, 3], "costs": {}, "best": 0, "step": 1}, b"\xff" * 24), "not finite"),
        (
            message({"type": "plan", "shape": [1, 2, 3], "costs": {}, "best": 0, "step": 1, "model": "x"}, b"\0" * 24),
            "model",
        ),
    ],
)
def test_garbage_is_refused_in_one_sentence(garbage: bytes, reason: str):
    with socket.create_server(("127.0.0.1", 0)) as listener:
        threading.Thread(target=answers, args=(listener, garbage, []), daemon=True).start()
        config = load(f"connect:127.0.0.1:{listener.getsockname()[1]}").Config()
        with pytest.raises(UserError, match=reason):
            Session(small_source(), config=config).tick()
        listener.shutdown(socket.SHUT_RDWR)


@pytest.mark.parametrize(
    ("parameter", "reason"),
    [
        ({"name": "class", "default": 1, "low": 0, "high": 2}, "'class' is not a name for a parameter"),
        ({"name": "parameters", "default": 1, "low": 0, "high": 2}, "'parameters' is not a name for a parameter"),
        ({"name": "reach", "default": 3, "low": 0, "high": 2}, r"the parameter 'reach' is 3 in \[0, 2\]"),
        ({"name": "reach", "default": 3, "low": 0, "high": 1e400}, "Infinity is not a number of JSON"),
        ({"name": "reach"}, "KeyError|'default'"),
    ],
)
def test_parameters_that_cannot_be_used_are_refused(parameter: dict[str, object], reason: str):
    with socket.create_server(("127.0.0.1", 0)) as listener:
        threading.Thread(target=answers, args=(listener, b"", [parameter]), daemon=True).start()
        with pytest.raises(UserError, match=f"No planner can be used at .*{reason}"):
            load(f"connect:127.0.0.1:{listener.getsockname()[1]}")
        listener.shutdown(socket.SHUT_RDWR)


def test_an_address_without_a_planner_is_refused(tmp_path: Path):
    with pytest.raises(UserError, match=r"No planner can be used at .*nothing listens there"):
        load(f"connect:{tmp_path}/absent.sock")
    with pytest.raises(UserError, match=r"example.com is not this computer"):
        load("connect:example.com:80")


def test_rules_end_a_flight_before_its_planner_does(start: Callable[..., str], world: World):
    result = fly(world, config=load(start()).Config(), rules=FlightRules(time_limit=0.1))
    assert result.reason == "timeout"
