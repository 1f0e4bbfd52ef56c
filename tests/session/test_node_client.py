"""The client of a node: frames from its messages, and connections that fail."""

import re
import shutil
import socket
import subprocess
import sys
import threading
import time
from contextlib import closing, suppress

import numpy as np
import pytest
from ensemble_plans import plan_of

from aero_planner import PlannerConfig
from aero_planner.onboard.interfaces import PlanRecord
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.telemetry import Telemetry, encode_plan
from aero_planner.onboard.telemetry_protocol import Kind, MessageReader, encode
from aero_viz.errors import UserError
from aero_viz.session.frame import Frame
from aero_viz.session.node_client import NodeClient
from tests.planner.onboard.simulated import SMALL


def test_frames_hold_the_drones_plans(telemetry: Telemetry, records: list[PlanRecord]):
    client = NodeClient("127.0.0.1", telemetry.port)
    assert client.config == SMALL and client.onboard.rates.replan == 25.0
    frames, stream = [], iter(client)
    for record in records[:8]:
        telemetry.observe(record)
        frame = next(stream)
        assert isinstance(frame, Frame)
        frames.append(frame)
    client.close()
    assert list(stream) == []
    for frame, record in zip(frames, records, strict=False):
        assert frame.index == record.number and frame.config == SMALL
        np.testing.assert_array_equal(frame.plan.positions, record.plan.positions)
        np.testing.assert_array_equal(frame.plan.command, record.plan.command)
        np.testing.assert_array_equal(plan_of(frame).continued_cells, record.plan.continued_cells)
        np.testing.assert_array_equal(frame.plan.disturbance, record.plan.disturbance)
        assert frame.plan.drag == record.plan.drag
        assert frame.plan.status is record.plan.status and frame.plan.kinds == record.plan.kinds
        np.testing.assert_array_equal(frame.observation.goal.position, record.goal)
        assert frame.observation.cloud_age == record.cloud_age
        assert frame.explanation is not None and frame.explanation.startswith(record.safety.name)
    assert frames[-1].time == pytest.approx(records[7].time - records[0].time)
    np.testing.assert_allclose(frames[-1].trail[-1], np.asarray(records[7].measured.position), atol=1e-6)
    assert len(frames[3].trail) == 4 and not frames[3].trail.flags.writeable
    assert frames[-1].rate == pytest.approx(7 / frames[-1].time)
    assert frames[0].source is frames[-1].source and frames[0].source.period == 0.04


def test_a_plan_of_an_older_node_says_nothing_of_continued_cells(records: list[PlanRecord]):
    (plan,) = MessageReader().feed(encode_plan(records[0], points_max=100))
    arrays = {name: array for name, array in plan.arrays.items() if name != "continued_cells"}
    hello = encode(Kind.HELLO, {"planner": SMALL.to_dict(), "onboard": OnboardConfig().to_dict()})
    with socket.create_server(("127.0.0.1", 0)) as server:
        answer = hello + encode(Kind.PLAN, plan.values, arrays)
        thread = threading.Thread(target=lambda: server.accept()[0].sendall(answer))
        thread.start()
        with closing(NodeClient("127.0.0.1", server.getsockname()[1])) as client:
            frame = next(iter(client))
        thread.join()
    assert isinstance(frame, Frame) and plan_of(frame).continued_cells is None
    np.testing.assert_array_equal(plan_of(frame).fine_range, records[0].plan.fine_range)


_LOST_LINK = """
import socket, subprocess, threading
from aero_planner import PlannerConfig
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.telemetry_protocol import Kind, encode
from aero_viz.session.node_client import NodeClient
from aero_viz.errors import UserError

subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
hello = encode(Kind.HELLO, {"planner": PlannerConfig().to_dict(), "onboard": OnboardConfig().to_dict()})
server, connections = socket.create_server(("127.0.0.1", 0)), []

def accept():
    connections.append(server.accept()[0])
    connections[0].sendall(hello)

threading.Thread(target=accept).start()
client = NodeClient("127.0.0.1", server.getsockname()[1])
subprocess.run(["ip", "link", "set", "lo", "down"], check=True)
try:
    print(list(client))
except UserError as error:
    print(error)
"""


def test_a_link_that_drops_silently_is_detected():
    """In a separate network namespace, packets stop without FIN or RST."""
    alone = ["unshare", "--user", "--map-root-user", "--net"]
    if not shutil.which("unshare") or not shutil.which("ip") or subprocess.run([*alone, "true"]).returncode:
        pytest.skip("needs Linux's user and network namespaces, and iproute2")
    command = [*alone, sys.executable, "-c", _LOST_LINK]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60.0)
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(r"the connection to 127\.0\.0\.1:\d+ is lost: .+\.\n", done.stdout), done.stdout


def test_an_address_without_a_node_is_named_in_the_error():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        with pytest.raises(UserError, match=rf"No node answers at 127.0.0.1:{port}: Connection refused; start"):
            NodeClient("127.0.0.1", port)
    for host in ("no such host", "a" * 70, ""):
        with pytest.raises(UserError, match="No node answers at"):
            NodeClient(host, 1)


@pytest.mark.parametrize(
    ("answer", "problem"),
    [
        (b"SSH-2.0-OpenSSH_9.6\r\n" + bytes(40), "no aero-planner node"),
        (b"", "accepts no further viewer, or is not a node"),
        (encode(Kind.CHANGE, {}), "is not a node"),
        (encode(Kind.HELLO, {}), "other settings than this program knows"),
        (encode(Kind.HELLO, {"planner": {"costs": {"new": 1}}, "onboard": {}}), "install the same release"),
        (encode(Kind.HELLO, {"planner": {}, "onboard": {"limits": {"new": 1}}}), "install the same release"),
    ],
)
def test_a_server_that_is_not_a_node_of_this_release_is_refused(answer: bytes, problem: str):
    with socket.create_server(("127.0.0.1", 0)) as server:

        def respond() -> None:
            connection, _ = server.accept()
            with connection, suppress(OSError):
                connection.sendall(answer)

        thread = threading.Thread(target=respond)
        thread.start()
        with pytest.raises(UserError, match=problem) as raised:
            NodeClient("127.0.0.1", server.getsockname()[1])
        thread.join()
    assert "\n" not in str(raised.value)


def test_malformed_messages_end_the_connection_with_an_error(records: list[PlanRecord]):
    hello = encode(Kind.HELLO, {"planner": PlannerConfig().to_dict(), "onboard": OnboardConfig().to_dict()})
    nonsense = [encode(Kind.PLAN, {}), encode(Kind.PLAN, {"number": "a"}, {"points": np.zeros(3, np.int16)}), b"x" * 50]
    for message in nonsense:
        with socket.create_server(("127.0.0.1", 0)) as server:
            thread = threading.Thread(target=lambda m=message, s=server: s.accept()[0].sendall(hello + m))
            thread.start()
            with (
                pytest.raises(UserError, match=r"127\.0\.0\.1"),
                closing(NodeClient("127.0.0.1", server.getsockname()[1])) as client,
            ):
                next(iter(client))
            thread.join()


def test_a_greeting_that_trickles_in_does_not_hold_up_the_connection():
    with socket.create_server(("127.0.0.1", 0)) as server:

        def trickle() -> None:
            connection, _ = server.accept()
            with connection, suppress(OSError):
                for byte in b"AERO" + bytes(10_000):
                    connection.sendall(bytes([byte]))
                    time.sleep(0.1)

        thread = threading.Thread(target=trickle, daemon=True)
        thread.start()
        with pytest.raises(UserError, match="sends no greeting"):
            NodeClient("127.0.0.1", server.getsockname()[1], timeout=0.5)
        thread.join(timeout=60.0)
        assert not thread.is_alive(), "the connection was closed"
