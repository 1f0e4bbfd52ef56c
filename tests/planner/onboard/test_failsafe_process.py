"""The guard as it flies: its shared memory, and the process itself with a real socket, or serial line, to talk to."""

from __future__ import annotations

import logging
import math
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
from aero_planner.onboard.dead_reckoning import MotionState
from aero_planner.onboard.failsafe_process import FailsafeProcess, HeartbeatMemory, takeover_time
from aero_planner.onboard.frames import flu_from_frd
from aero_planner.onboard.mavlink import load_dialect
from aero_planner.onboard.node import Node
from aero_planner.onboard.safety_machine import State
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.transport import open_transport
from aero_planner.onboard.watchdog import AHEAD, Heartbeat
from tests.planner.onboard.simulated import GOAL
from tests.planner.onboard.test_node_life import StandingLidar, StandingLink

mavlink = load_dialect()
VEHICLE = PlannerConfig().vehicle
CONFIG = OnboardConfig().replace({"limits.blind_time": 0.6})
PERIOD = 1.0 / CONFIG.rates.control
HOVER = np.array([VEHICLE.mass * VEHICLE.gravity, 0.0, 0.0, 0.0])
PATIENCE = 20.0
"""With a busy machine [s]."""


def forward(now: float) -> MotionState:
    """Level, north at 4 m/s."""
    return MotionState(now, np.zeros(3), np.array([4.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0]))


# --- the memory -------------------------------------------------------------------------------------------------------


@pytest.fixture
def file() -> Iterator[int]:
    file = HeartbeatMemory.new_file()
    yield file
    os.close(file)


@pytest.fixture
def memory(file: int) -> HeartbeatMemory:
    return HeartbeatMemory(file)


def test_what_is_written_is_read_by_the_other_side(memory: HeartbeatMemory, file: int):
    other = HeartbeatMemory(file)
    assert other.read() is None
    motion = MotionState(4.9, np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0]), np.array([0.5, 0.5, -0.5, 0.5]))
    for count in range(1, 5):
        memory.write(Heartbeat(5.0 + count, motion, np.array([9.0, 0.1, 0.2, count])), "udpout:10.0.0.1:14540")
        number, beat, target = other.read() or pytest.fail("there is none")
        assert (number, beat.time, target) == (count, 5.0 + count, "udpout:10.0.0.1:14540")
        assert beat.motion is not None and beat.motion.time == 4.9
        for name in ("position", "velocity", "quaternion"):
            np.testing.assert_array_equal(getattr(beat.motion, name), getattr(motion, name))
        np.testing.assert_array_equal(beat.command, [9.0, 0.1, 0.2, count])
    ahead = np.arange(4.0 * (AHEAD + 3)).reshape(-1, 4)
    for told in (ahead[:1], ahead[:5], ahead[:AHEAD], ahead):
        memory.write(Heartbeat(9.0, motion, HOVER, told), None)
        _, beat, _ = other.read() or pytest.fail("there is none")
        np.testing.assert_array_equal(beat.ahead, told[:AHEAD])
    memory.write(Heartbeat(10.0, None, None), None)
    assert other.read() == (9, Heartbeat(10.0, None, None), None)
    assert memory.reported() == (False, False, 0)
    other.report(8, 3)
    assert memory.reported() == (True, False, 3)
    other.report(9, 3)
    assert memory.reported() == (True, True, 3)
    memory.write(Heartbeat(11.0, None, None), None)
    assert memory.reported() == (True, False, 3)  # it acts on a beat that is none any more


def test_a_motion_that_is_not_finite_is_none(memory: HeartbeatMemory):
    memory.write(Heartbeat(5.0, forward(math.nan), np.array([9.0, math.inf, 0.0, 0.0])), None)
    assert memory.read() == (1, Heartbeat(5.0, None, None), None)


@pytest.mark.parametrize("written", [1, 2, 3, 4])
def test_a_writer_stopped_anywhere_leaves_the_beat_before(memory: HeartbeatMemory, written: int):
    for count in range(1, written + 1):
        memory.write(Heartbeat(float(count), forward(count), HOVER + count), f"udpout:127.0.0.1:{count}")
    before = memory._memory[:]
    memory.write(Heartbeat(-7.0, forward(-7.0), -HOVER), "/dev/ttyTHS1")
    after = memory._memory[:]
    (changed,) = np.nonzero(np.frombuffer(before, np.uint8) != np.frombuffer(after, np.uint8))
    first, last = int(changed[0]), int(changed[-1])
    for end in range(first, last + 1):
        memory._memory[:] = after[:end] + before[end:]
        found = memory.read()
        assert found is not None and found[0] == written and found[1].time == written, end
    # The same in any other order of bytes, such as a processor that writes the end first.
    for begin in range(first + 1, last + 1):
        memory._memory[:] = before[:begin] + after[begin:]
        found = memory.read()
        assert found is not None and found[0] == written, begin
    memory._memory[:] = after
    found = memory.read()
    assert found is not None and found[0] == written + 1 and found[2] == "/dev/ttyTHS1"


# --- the process ------------------------------------------------------------------------------------------------------


class Autopilot:
    """Listens to commands."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self.url = f"udpout:127.0.0.1:{self._socket.getsockname()[1]}"
        self._parser = mavlink.MAVLink(None)

    def close(self) -> None:
        self._socket.close()

    def receive(self, timeout: float) -> tuple[float, np.ndarray] | None:
        """Return when the next command arrived [s] and signal and body rates, forward-left-up; None when none came."""
        if not select.select([self._socket], [], [], timeout)[0]:
            return None
        now = time.monotonic()
        (message,) = self._parser.parse_buffer(self._socket.recv(2048))
        assert message.get_type() == "SET_ATTITUDE_TARGET"
        assert (message.get_srcSystem(), message.get_srcComponent()) == (1, 191)
        rates = flu_from_frd([message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate])
        return now, np.array([message.thrust, *rates])

    def receive_all(self) -> list[tuple[float, np.ndarray]]:
        """Return commands until none has come for much longer than a period, after the first."""
        commands, next = [], self.receive(PATIENCE)
        while next is not None:
            commands.append(next)
            next = self.receive(0.5)
        return commands


@pytest.fixture
def autopilot() -> Iterator[Autopilot]:
    autopilot = Autopilot()
    yield autopilot
    autopilot.close()


@pytest.fixture
def guard(autopilot: Autopilot) -> Iterator[FailsafeProcess]:
    guard = FailsafeProcess(CONFIG, VEHICLE, lambda: autopilot.url)
    guard.wait(PATIENCE)
    yield guard
    guard.close()


def fly(guard: FailsafeProcess, ticks: int = 10) -> float:
    """Be a node that is obeyed, for some ticks; return when it was last [s]."""
    now = time.monotonic()
    for _ in range(ticks):
        now = time.monotonic()
        guard.beat(Heartbeat(now, forward(now), HOVER))
        time.sleep(PERIOD)
    return now


def check_braking(commands: list[tuple[float, np.ndarray]]) -> None:
    """Check that a drone flying north is braked and then told to hover, see `forward`."""
    (_, first), (_, last) = commands[0], commands[-1]
    # Nose up, in forward-left-up a negative pitch rate, with which the thrust turns backwards.
    assert first[2] < -1.0 and abs(first[1]) < 0.1 and first[3] == 0.0
    np.testing.assert_allclose(last, [CONFIG.thrust.hover_thrust, 0.0, 0.0, 0.0], atol=1e-6)
    # As long as it was to be, give and take what a busy machine adds.
    assert CONFIG.limits.blind_time - 2 * PERIOD < commands[-1][0] - commands[0][0] < CONFIG.limits.blind_time + 1.0
    assert len(commands) > 5


def test_when_beats_stop_it_brakes_hovers_and_is_silent(guard: FailsafeProcess, autopilot: Autopilot):
    last = fly(guard)
    commands = autopilot.receive_all()
    assert takeover_time(CONFIG) < commands[0][0] - last < takeover_time(CONFIG) + 1.0
    check_braking(commands)
    # It stays, and guards again.
    fly(guard)
    check_braking(autopilot.receive_all())
    guard.close()
    assert guard.interventions == 2 and not guard.lost


def test_until_then_it_goes_on_with_the_plan(guard: FailsafeProcess, autopilot: Autopilot):
    now = time.monotonic()
    ahead = np.array([[VEHICLE.mass * VEHICLE.gravity, 0.0, 0.0, 0.01 * k] for k in range(1, 7)])
    guard.beat(Heartbeat(now, forward(now), HOVER, ahead))
    commands = autopilot.receive_all()
    planned = [values for _, values in commands if values[3] != 0.0]
    braking = commands[len(planned) :]
    # A yaw rate is nothing that braking asks for. How many there are depends on how busy the machine is.
    steps = np.round(100.0 * np.array([values[3] for values in planned]))
    assert len(planned) > 0 and (np.diff(steps) > 0).all() and set(steps) <= {1, 2, 3, 4, 5, 6}
    check_braking(braking)


def test_beats_that_come_back_make_it_silent_at_once(guard: FailsafeProcess, autopilot: Autopilot):
    fly(guard, 3)
    assert not guard.braking
    assert autopilot.receive(PATIENCE) is not None
    while not guard.braking:  # the report follows the command
        assert autopilot.receive(PATIENCE) is not None
    fly(guard, 3)
    assert not guard.braking
    while autopilot.receive(0.0) is not None:
        pass
    fly(guard, 30)
    assert autopilot.receive(0.0) is None


def test_closed_in_flight_it_says_nothing(guard: FailsafeProcess, autopilot: Autopilot):
    fly(guard)
    guard.close()
    guard.close()
    guard.beat(Heartbeat(time.monotonic(), None, None))
    assert autopilot.receive(2 * takeover_time(CONFIG)) is None
    assert not guard.lost


def test_where_the_drone_does_not_obey_it_says_nothing(guard: FailsafeProcess, autopilot: Autopilot):
    fly(guard)
    now = time.monotonic()
    guard.beat(Heartbeat(now, forward(now), None))
    assert autopilot.receive(2 * takeover_time(CONFIG)) is None


def test_signals_to_all_do_not_end_it(guard: FailsafeProcess, autopilot: Autopilot):
    assert os.getpgid(guard._process.pid) != os.getpgid(0)  # what Ctrl-C and Ctrl-Z reach
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        guard._process.send_signal(number)
    fly(guard)
    check_braking(autopilot.receive_all())


def test_a_guard_that_dies_is_told_of_once(guard: FailsafeProcess, caplog: pytest.LogCaptureFixture):
    fly(guard, 2)
    assert not guard.lost
    guard._process.kill()
    guard._process.wait()
    with caplog.at_level(logging.ERROR):
        fly(guard, 3)
    assert guard.lost and caplog.text.count("the guard has ended with code -9") == 1


def test_a_guard_that_does_not_start_is_an_error(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "executable", "/bin/false")
    guard = FailsafeProcess(CONFIG, VEHICLE, lambda: None)
    with pytest.raises(OSError, match=r"the guard, .*, has ended with code 1"):
        guard.wait(PATIENCE)
    guard.close()
    monkeypatch.setattr(sys, "executable", "/absent/python")
    with pytest.raises(OSError, match="absent"):
        FailsafeProcess(CONFIG, VEHICLE, lambda: None)


CALM = CONFIG.replace({"limits.deadline": 1.0})
"""With a process that stands still: what is done at once is told from what is done after that."""

NODE = """
import sys, time
from aero_planner.onboard.failsafe_process import FailsafeProcess
from tests.planner.onboard.test_failsafe_process import CALM, PATIENCE, VEHICLE, fly

guard = FailsafeProcess(CALM, VEHICLE, lambda: sys.argv[1])
guard.wait(PATIENCE)
print("flying", flush=True)
while True:
    fly(guard, 1)
"""


@pytest.fixture
def node(autopilot: Autopilot) -> Iterator[subprocess.Popen[str]]:
    """A process that is obeyed, and guarded."""
    command = [sys.executable, "-c", NODE, autopilot.url]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdout.readline() == "flying\n"
        time.sleep(5 * PERIOD)
        yield process
        process.kill()


def test_a_process_that_is_killed_is_replaced_until_the_drone_hovers(node: subprocess.Popen[str], autopilot: Autopilot):
    node.kill()
    killed = time.monotonic()
    commands = autopilot.receive_all()
    assert commands[0][0] - killed < 0.5 * CALM.limits.deadline
    check_braking(commands)
    # The guard holds the other end of this, too: it has ended.
    assert "the guard brakes" in node.communicate(timeout=PATIENCE)[1]


def test_a_process_that_is_stopped_is_replaced_and_takes_over_again(node: subprocess.Popen[str], autopilot: Autopilot):
    node.send_signal(signal.SIGSTOP)
    check_braking(autopilot.receive_all())
    node.send_signal(signal.SIGCONT)
    assert autopilot.receive(1.5 * takeover_time(CALM)) is None
    node.send_signal(signal.SIGSTOP)
    assert autopilot.receive(PATIENCE) is not None


def test_a_serial_line_is_shared():
    there, device = os.openpty()
    name = os.ttyname(device)
    port = open_transport(name, baud=115_200)
    before = termios.tcgetattr(device)
    assert port.partner == name and port.send(b"the node's last words")
    guard = FailsafeProcess(CONFIG, VEHICLE, lambda: port.partner)
    try:
        guard.wait(PATIENCE)
        fly(guard)
        assert select.select([there], [], [], PATIENCE)[0]
        time.sleep(takeover_time(CONFIG) + 3 * PERIOD)
        data = os.read(there, 4096)
        # What the node wrote is still there, and its settings hold.
        assert data.startswith(b"the node's last words")
        messages = mavlink.MAVLink(None).parse_buffer(data[len(b"the node's last words") :])
        assert messages[0].get_type() == "SET_ATTITUDE_TARGET"
        assert termios.tcgetattr(device) == before
    finally:
        guard.close()
        port.close()
        os.close(there)
        os.close(device)


def test_it_and_the_nodes_own_watchdog_never_speak_both(
    small_planner: Planner, guard: FailsafeProcess, autopilot: Autopilot, caplog: pytest.LogCaptureFixture
):
    small_planner.reset()
    link = StandingLink()
    config = CONFIG.replace({"limits.plan_age": 1.0, "limits.cloud_age": 2.0, "limits.state_age": 1.0})
    node = Node(small_planner, link, StandingLidar(), config, goal=GOAL, guard=guard)
    node.warm_up()
    node.start()
    try:
        assert link.wait_for_commands()
        link.armed = link.offboard = True
        assert link.wait_for_commands()
        # The control loop fails: the watchdog, in this process, brakes to the end.
        link.failing = True
        with caplog.at_level(logging.WARNING):
            end = time.monotonic() + PATIENCE
            while "the watchdog has braked for as long as it may" not in caplog.text:
                assert time.monotonic() < end
                time.sleep(PERIOD)
        assert "the watchdog brakes" in caplog.text and not guard.braking
        while (command := autopilot.receive(0.0)) is not None:  # of a plan, when a tick was late
            assert command[0] < time.monotonic()
    finally:
        node.close()
    assert autopilot.receive(2 * takeover_time(config)) is None
    statistics = node.statistics()
    assert statistics["watchdog_interventions"] == 1
    assert statistics["failsafe_interventions"] == 0 and statistics["failsafe_lost"] is False


def test_after_the_guard_has_braked_the_watchdog_waits_for_the_control_loop(
    small_planner: Planner, guard: FailsafeProcess, autopilot: Autopilot
):
    small_planner.reset()
    link = StandingLink()
    node = Node(small_planner, link, StandingLidar(), CONFIG, goal=GOAL, guard=guard)
    try:
        # No threads of its own: it stands still as a whole, as soon as nothing here lets it go on.
        end = time.monotonic() + PATIENCE
        while node.state is not State.READY:
            assert time.monotonic() < end
            node.control_once()
            node.plan_once()
        link.armed = link.offboard = True
        node.control_once()
        count = link.count
        while not guard.braking:
            assert autopilot.receive(PATIENCE) is not None
        assert not node.watch_once() and link.count == count
        node.control_once()
        assert link.count == count + 1 and not guard.braking
    finally:
        node.close()
