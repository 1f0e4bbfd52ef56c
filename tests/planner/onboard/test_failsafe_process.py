"""The failsafe process, with a real socket or serial line."""

import logging
import os
import select
import signal
import socket
import subprocess
import sys
import termios
import time
from collections.abc import Iterator

import numpy as np
import pytest

from aero_planner import Planner, PlannerConfig
from aero_planner.onboard.failsafe_process import FailsafeProcess, takeover_time
from aero_planner.onboard.failsafe_table import State
from aero_planner.onboard.frames import flu_from_frd
from aero_planner.onboard.mavlink_sender import load_dialect
from aero_planner.onboard.node import Node
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.transport import open_transport
from aero_planner.onboard.watchdog import Heartbeat
from tests.planner.onboard.simulated import GOAL, flying_north
from tests.planner.onboard.test_node_life import StandingLidar, StandingLink

mavlink = load_dialect()
VEHICLE = PlannerConfig().vehicle
CONFIG = OnboardConfig().replace({"limits.blind_time": 1.2, "limits.deadline": 1.0, "rates.control": 10.0})
"""Slow, so that no tick of a busy machine is late: one that is, by half a period, is replaced."""
PERIOD = 1.0 / CONFIG.rates.control
HOVER = np.array([VEHICLE.mass * VEHICLE.gravity, 0.0, 0.0, 0.0])
PATIENCE = 60.0
"""Timeout for a busy machine [s]."""


class Autopilot:
    """Receives commands."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self.url = f"udpout:127.0.0.1:{self._socket.getsockname()[1]}"
        self._parser = mavlink.MAVLink(None)

    def close(self) -> None:
        self._socket.close()

    def receive(self, timeout: float) -> tuple[float, np.ndarray] | None:
        """Return the time of the next command [s], and its thrust signal and body rates (FLU); None after `timeout`."""
        if not select.select([self._socket], [], [], timeout)[0]:
            return None
        now = time.monotonic()
        (message,) = self._parser.parse_buffer(self._socket.recv(2048))
        assert message.get_type() == "SET_ATTITUDE_TARGET"
        assert (message.get_srcSystem(), message.get_srcComponent()) == (1, 191)
        rates = flu_from_frd([message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate])
        return now, np.array([message.thrust, *rates])

    def receive_all(self) -> list[tuple[float, np.ndarray]]:
        """Return all commands until none has arrived for much longer than a period."""
        commands, command = [], self.receive(PATIENCE)
        while command is not None:
            commands.append(command)
            command = self.receive(2.0)
        return commands


@pytest.fixture
def autopilot() -> Iterator[Autopilot]:
    autopilot = Autopilot()
    yield autopilot
    autopilot.close()


@pytest.fixture
def failsafe(autopilot: Autopilot) -> Iterator[FailsafeProcess]:
    failsafe = FailsafeProcess(CONFIG, VEHICLE, lambda: autopilot.url)
    failsafe.wait_until_running(PATIENCE)
    yield failsafe
    failsafe.close()


def fly(failsafe: FailsafeProcess, ticks: int = 10) -> float:
    """Report the heartbeats of a node that is obeyed; return the time of the last [s]."""
    now = time.monotonic()
    for _ in range(ticks):
        now = time.monotonic()
        failsafe.report(Heartbeat(now, flying_north(now), HOVER))
        time.sleep(0.02)
    return now


def check_braking(commands: list[tuple[float, np.ndarray]], *, early: float = 0.0) -> None:
    """Check that a drone flying north, see `flying_north`, is braked and then commanded to hover.

    Without a plan it is stopped from the first late tick on, at most `early` seconds before the deadline.
    """
    (_, first), (_, last) = commands[0], commands[-1]
    # Nose up, which is a negative pitch rate in forward-left-up, so that the thrust points backwards.
    assert first[2] < -1.0 and abs(first[1]) < 0.1 and first[3] == 0.0
    np.testing.assert_allclose(last, [CONFIG.thrust.hover_thrust, 0.0, 0.0, 0.0], atol=1e-6)
    # For the time required, with a tolerance for a busy machine.
    required = CONFIG.limits.blind_time
    assert required - 2 * PERIOD < commands[-1][0] - commands[0][0] < required + early + 10.0
    assert len(commands) > 5


def test_when_heartbeats_stop_it_brakes_hovers_and_falls_silent(failsafe: FailsafeProcess, autopilot: Autopilot):
    last = fly(failsafe)
    commands = autopilot.receive_all()
    assert PERIOD < commands[0][0] - last < takeover_time(CONFIG) + 10.0  # no plan was flown
    check_braking(commands)
    # It continues to run, and brakes again.
    fly(failsafe)
    check_braking(autopilot.receive_all())
    failsafe.close()
    assert failsafe.interventions == 2 and not failsafe.lost


def test_until_the_deadline_it_flies_the_planned_commands(failsafe: FailsafeProcess, autopilot: Autopilot):
    now = time.monotonic()
    upcoming = np.array([[VEHICLE.mass * VEHICLE.gravity, 0.0, 0.0, 0.002 * k] for k in range(1, 7)])
    failsafe.report(Heartbeat(now, flying_north(now), HOVER, upcoming))
    commands = autopilot.receive_all()
    planned = [values for _, values in commands if values[3] != 0.0]
    braking = commands[len(planned) :]
    # Braking never asks for a yaw rate. The number of planned commands depends on how busy the machine is.
    steps = np.round(500.0 * np.array([values[3] for values in planned]))
    assert len(planned) > 0 and (np.diff(steps) > 0).all() and set(steps) <= {1, 2, 3, 4, 5, 6}
    check_braking(braking)


def test_it_falls_silent_at_once_when_heartbeats_return(failsafe: FailsafeProcess, autopilot: Autopilot):
    fly(failsafe, 3)
    assert not failsafe.braking
    assert autopilot.receive(PATIENCE) is not None
    while not failsafe.braking:  # the status is written after the command
        assert autopilot.receive(PATIENCE) is not None
    end = time.monotonic() + PATIENCE
    while failsafe.braking:
        assert time.monotonic() < end
        fly(failsafe, 1)
    while autopilot.receive(0.0) is not None:
        pass
    fly(failsafe, 10)
    assert autopilot.receive(0.0) is None


def test_it_sends_nothing_when_closed_in_flight(failsafe: FailsafeProcess, autopilot: Autopilot):
    fly(failsafe)
    failsafe.close()
    while autopilot.receive(0.0) is not None:
        pass  # on a busy machine a tick of the flight was late, and the process sent a command before it was closed
    failsafe.close()
    failsafe.report(Heartbeat(time.monotonic(), None, None))
    assert autopilot.receive(2 * takeover_time(CONFIG)) is None
    assert not failsafe.lost


def test_it_sends_nothing_to_a_drone_that_does_not_obey(failsafe: FailsafeProcess, autopilot: Autopilot):
    fly(failsafe)
    now = time.monotonic()
    failsafe.report(Heartbeat(now, flying_north(now), None))
    assert autopilot.receive(2 * takeover_time(CONFIG)) is None


def test_signals_to_the_process_group_do_not_end_it(failsafe: FailsafeProcess, autopilot: Autopilot):
    assert os.getpgid(failsafe.pid) != os.getpgid(0)  # Ctrl-C and Ctrl-Z reach only the latter
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        os.kill(failsafe.pid, number)
    fly(failsafe)
    check_braking(autopilot.receive_all())


def test_its_death_is_logged_once(failsafe: FailsafeProcess, caplog: pytest.LogCaptureFixture):
    fly(failsafe, 2)
    assert not failsafe.lost
    os.kill(failsafe.pid, signal.SIGKILL)
    os.waitid(os.P_PID, failsafe.pid, os.WEXITED | os.WNOWAIT)
    with caplog.at_level(logging.ERROR):
        fly(failsafe, 3)
    assert failsafe.lost and caplog.text.count("the failsafe process has ended with code -9") == 1


def test_one_that_hangs_is_logged_and_noticed_when_it_continues(
    failsafe: FailsafeProcess, caplog: pytest.LogCaptureFixture
):
    fly(failsafe, 2)
    os.kill(failsafe.pid, signal.SIGSTOP)
    end = time.monotonic() + PATIENCE
    while not failsafe.lost:
        assert time.monotonic() < end
        fly(failsafe, 1)
    assert caplog.text.count("the failsafe process hangs: nothing brakes if this process dies") == 1
    os.kill(failsafe.pid, signal.SIGCONT)
    while failsafe.lost:
        assert time.monotonic() < end
        fly(failsafe, 1)
    assert "the failsafe process runs again" in caplog.text


def test_a_process_that_does_not_start_is_an_error(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "executable", "/bin/false")
    failsafe = FailsafeProcess(CONFIG, VEHICLE, lambda: None)
    with pytest.raises(OSError, match=r"the failsafe process, .*, has ended with code 1"):
        failsafe.wait_until_running(PATIENCE)
    failsafe.close()
    monkeypatch.setattr(sys, "executable", "/absent/python")
    with pytest.raises(OSError, match="absent"):
        FailsafeProcess(CONFIG, VEHICLE, lambda: None)


NODE = """
import sys, time
from aero_planner.onboard.failsafe_process import FailsafeProcess
from tests.planner.onboard.test_failsafe_process import CONFIG, PATIENCE, VEHICLE, fly

failsafe = FailsafeProcess(CONFIG, VEHICLE, lambda: sys.argv[1])
failsafe.wait_until_running(PATIENCE)
print("flying", flush=True)
while True:
    fly(failsafe, 1)
"""


@pytest.fixture
def node(autopilot: Autopilot) -> Iterator[subprocess.Popen[str]]:
    """A process that the drone obeys, with a failsafe process."""
    command = [sys.executable, "-c", NODE, autopilot.url]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdout.readline() == "flying\n"
        time.sleep(5 * PERIOD)
        yield process
        process.kill()


def test_after_the_node_is_killed_it_brakes_until_the_drone_hovers(node: subprocess.Popen[str], autopilot: Autopilot):
    node.kill()
    killed = time.monotonic()
    commands = autopilot.receive_all()
    assert commands[0][0] - killed < CONFIG.limits.deadline
    check_braking(commands)
    # `communicate` returns only when the failsafe process, which inherited this pipe, has ended, too.
    assert "the failsafe process brakes" in node.communicate(timeout=PATIENCE)[1]


def test_a_stopped_node_takes_over_again_when_it_continues(node: subprocess.Popen[str], autopilot: Autopilot):
    node.send_signal(signal.SIGSTOP)
    check_braking(autopilot.receive_all(), early=takeover_time(CONFIG))
    node.send_signal(signal.SIGCONT)
    assert autopilot.receive(1.5 * takeover_time(CONFIG)) is None
    node.send_signal(signal.SIGSTOP)
    assert autopilot.receive(PATIENCE) is not None


def test_a_serial_line_is_shared_with_the_node():
    there, device = os.openpty()
    name = os.ttyname(device)
    port = open_transport(name, baud=115_200)
    before = termios.tcgetattr(device)
    assert port.peer == name and port.send(b"the node's last words")
    failsafe = FailsafeProcess(CONFIG, VEHICLE, lambda: port.peer)
    try:
        failsafe.wait_until_running(PATIENCE)
        fly(failsafe)
        # What the node has written is still there, and its settings are unchanged.
        words, parser, messages = b"the node's last words", mavlink.MAVLink(None), None
        assert os.read(there, len(words)) == words
        while not messages:
            assert select.select([there], [], [], PATIENCE)[0]
            messages = parser.parse_buffer(os.read(there, 4096))
        assert messages[0].get_type() == "SET_ATTITUDE_TARGET"
        assert termios.tcgetattr(device) == before
    finally:
        failsafe.close()
        port.close()
        os.close(there)
        os.close(device)


def test_it_and_the_watchdog_never_both_send(
    small_planner: Planner, failsafe: FailsafeProcess, autopilot: Autopilot, caplog: pytest.LogCaptureFixture
):
    small_planner.reset()
    link = StandingLink()
    config = CONFIG.replace({"limits.plan_age": 1.0, "limits.cloud_age": 2.0, "limits.state_age": 1.0})
    node = Node(small_planner, link, StandingLidar(), config, goal=GOAL, failsafe=failsafe)
    node.warm_up()
    node.start()
    try:
        assert link.wait_for_commands()
        link.armed = link.offboard = True
        assert link.wait_for_commands()
        # The control loop fails: the watchdog, in this process, brakes until its time is over.
        link.failing = True
        with caplog.at_level(logging.WARNING):
            end = time.monotonic() + PATIENCE
            while "the watchdog has braked for as long as it may" not in caplog.text:
                assert time.monotonic() < end
                time.sleep(PERIOD)
        assert "the watchdog brakes" in caplog.text and not failsafe.braking
        while (command := autopilot.receive(0.0)) is not None:  # a planned command, if a tick was late
            assert command[0] < time.monotonic()
    finally:
        node.close()
    assert autopilot.receive(2 * takeover_time(config)) is None
    statistics = node.statistics()
    assert statistics["watchdog_interventions"] == 1
    assert statistics["failsafe_interventions"] == 0 and statistics["failsafe_lost"] is False


def test_after_it_has_braked_the_watchdog_waits_for_the_control_loop(
    small_planner: Planner, failsafe: FailsafeProcess, autopilot: Autopilot
):
    small_planner.reset()
    link = StandingLink()
    node = Node(small_planner, link, StandingLidar(), CONFIG, goal=GOAL, failsafe=failsafe)
    try:
        # Without threads, the whole node stands still unless it is stepped here.
        end = time.monotonic() + PATIENCE
        while node.state is not State.READY:
            assert time.monotonic() < end
            node.control_once()
            node.plan_once()
        link.armed = link.offboard = True
        node.control_once()
        count = link.count
        while not failsafe.braking:
            assert autopilot.receive(PATIENCE) is not None
        assert not node.watch_once() and link.count == count
        node.control_once()
        assert link.count == count + 1 and not failsafe.braking
    finally:
        node.close()
