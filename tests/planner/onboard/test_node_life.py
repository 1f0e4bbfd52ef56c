"""The end of a node, faulty observers, and a node with real threads."""

import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from numpy.typing import ArrayLike

from aero_planner import Planner, VehicleState
from aero_planner.mission_progress import MissionProgress
from aero_planner.onboard.failsafe_table import Reaction, State
from aero_planner.onboard.interfaces import Observation, Observer, PointCounters, PointPacket, VehicleSample
from aero_planner.onboard.node import Node
from aero_planner.onboard.run import fly_until_signal
from aero_planner.onboard.settings import OnboardConfig
from tests.planner.onboard.simulated import GOAL, WORLD, Simulation, in_flight


def test_when_stopped_it_comes_to_rest_and_falls_silent(small_planner: Planner):
    flight = in_flight(small_planner)
    flight.node.stop()
    flight.run(0.1)
    assert flight.node.state is State.BRAKING and not flight.node.wait(0.0)
    assert flight.run_until(lambda: flight.node.wait(0.0), 5.0)
    assert flight.node.state is State.HANDED_BACK and flight.motion.speed < 0.5
    count = len(flight.link.sent)
    flight.run(1.0)
    assert len(flight.link.sent) == count and not flight.link.offboard
    flight.node.close()
    assert flight.link.closed and flight.lidar.closed


def test_when_closed_at_once_its_last_command_is_to_hover(small_planner: Planner):
    flight = in_flight(small_planner)
    flight.node.stop()
    flight.run(0.1)
    count = len(flight.link.sent)
    assert np.abs(flight.link.sent[-1][1][1:]).max() > 0.1  # body rates that would otherwise continue
    flight.node.close()
    np.testing.assert_allclose([command for _, command in flight.link.sent[count:]], [[9.81, 0.0, 0.0, 0.0]])


def test_when_closed_while_the_pilot_flies_it_sends_nothing(small_planner: Planner):
    simulation = Simulation(small_planner, WORLD, GOAL)
    simulation.run(0.5)
    count = len(simulation.link.sent)
    assert simulation.node.state is State.READY and count > 0
    simulation.node.close()
    assert len(simulation.link.sent) == count


class Faulty(Observer):
    """Raises in every method, and keeps what it was called with."""

    def __init__(self) -> None:
        self.calls: set[str] = set()

    def _fail(self, name: str) -> None:
        self.calls.add(name)
        raise RuntimeError(name)

    def observe(self, item: Observation) -> None:
        self._fail(type(item).__name__)

    def close(self) -> None:
        self._fail("close")


def test_faulty_observers_do_no_harm(small_planner: Planner):
    observer = Faulty()
    simulation = in_flight(small_planner, observers=[observer])
    simulation.node.close()
    assert {"PlanRecord", "StateChange", "VehicleSample", "PointPacket", "close"} == observer.calls


def test_errors_for_wrong_arguments_say_what_to_do(small_planner: Planner):
    with pytest.raises(ValueError, match=r"the goal is .*; it must be three finite numbers"):
        Simulation(small_planner, WORLD, (1.0, math.nan, 2.0))
    with pytest.raises(ValueError, match=r"the goal .* lies outside the geofence; correct it or limits\.fence_"):
        Simulation(small_planner, WORLD, (1.0, 500.0, 2.0))
    with pytest.raises(ValueError, match="less than the planner's horizon"):
        Simulation(small_planner, WORLD, GOAL, changes={"limits.plan_age": 1.5})


# --- real threads ---


class StandingLink:
    """A drone that stays in place in real time, whatever the commands."""

    def __init__(self) -> None:
        self.armed = self.offboard = False
        self.goal = np.array(GOAL)
        self.offer = None
        self.dropped: dict[str, int] = {}
        self.ignored: dict[str, int] = {}
        self.commands = threading.Condition()
        self.count = 0
        self.thrust_gain = 1.0
        self.failing = False
        self.velocity = np.zeros(3)
        self.peer = None
        self.min_signing_time = 0
        self.last = np.zeros(4)
        """The newest command."""

    @property
    def state(self) -> VehicleSample:
        now = time.monotonic()
        state = VehicleState(np.array([0.0, 0.0, 2.0]), self.velocity, np.array([1.0, 0.0, 0.0, 0.0]), None, now)
        return VehicleSample(now, state, self.armed, self.offboard, now, in_air=True)

    def poll(self) -> None:
        if self.failing:
            raise RuntimeError("a defect of the control loop")

    def report_mission(self, progress: MissionProgress | None) -> None:
        pass

    def send(self, command: ArrayLike, attitude: ArrayLike | None = None) -> None:
        with self.commands:
            self.last = np.array(command)
            self.count += 1
            self.commands.notify_all()

    def wait_for_commands(self, until: Callable[[], bool] = lambda: True) -> bool:
        """Wait for twenty more commands and for a condition; return False if they do not come within a minute."""
        with self.commands:
            last = self.count + 20
            return self.commands.wait_for(lambda: self.count >= last and until(), 60.0)

    def close(self) -> None:
        pass


class StandingLidar:
    """Sees the world from the drone's position."""

    counters = PointCounters()

    def poll(self) -> list[PointPacket]:
        points = (WORLD[::10] - np.array([0.0, 0.0, 2.0])).astype(np.float32)
        return [PointPacket(points, np.full(len(points), time.monotonic() - 0.001))]

    def close(self) -> None:
        pass


def test_with_real_threads(small_planner: Planner):
    small_planner.reset()
    link = StandingLink()
    # A shared machine may pause for a moment, so the limits are wide.
    config = OnboardConfig().replace({"limits.plan_age": 1.0, "limits.cloud_age": 2.0, "limits.state_age": 1.0})
    node = Node(small_planner, link, StandingLidar(), config)
    assert node.warm_up() > 0.0
    node.start()
    with pytest.raises(RuntimeError, match="already started"):
        node.start()
    try:
        assert link.wait_for_commands()
        assert node.safety.reaction is Reaction.BRAKE
        link.armed = link.offboard = True
        assert link.wait_for_commands()
        assert any(change.target is State.FLYING for change in node.changes)
        # A defect in the control loop itself: the watchdog acts in its place.
        link.failing = True
        assert link.wait_for_commands()
        assert node.failures > 0 and node.statistics()["watchdog_interventions"] >= 1
        link.failing = False
        node.stop()
        assert node.wait(60.0)
    finally:
        node.close()
    statistics = node.statistics()
    assert statistics["plans"] > 0 and statistics["control"]["ticks"] > 40
    assert not any(thread.name.startswith("aero-planner-control") for thread in threading.enumerate())


@pytest.fixture
def handlers() -> Iterator[None]:
    """Restores the signal handlers."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("handlers")
def test_a_lost_terminal_brakes_even_when_signalled_twice_and_a_second_signal_ends(small_planner: Planner):
    small_planner.reset()
    link = StandingLink()
    link.velocity = np.array([2.0, 0.0, 0.0])  # it never comes to rest, whatever the commands
    config = OnboardConfig().replace(
        {"limits.plan_age": 1.0, "limits.cloud_age": 2.0, "limits.state_age": 1.0, "limits.brake_time": 30.0}
    )
    node = Node(small_planner, link, StandingLidar(), config)
    node.warm_up()
    results: list[bool] = []

    def pilot() -> None:
        results.append(link.wait_for_commands())
        link.armed = link.offboard = True
        results.append(link.wait_for_commands())
        for number in (signal.SIGHUP, signal.SIGHUP, signal.SIGTERM):
            os.kill(os.getpid(), number)
            if number == signal.SIGHUP:
                results.append(link.wait_for_commands(lambda: node.state is State.BRAKING))

    thread = threading.Thread(target=pilot)
    began = time.monotonic()
    thread.start()
    assert fly_until_signal(node, config)
    thread.join()
    assert results == [True] * 4 and time.monotonic() - began < config.limits.brake_time
    np.testing.assert_allclose(link.last, [9.81, 0.0, 0.0, 0.0])
