"""Changes of a drone's parameters from a session, over a link that loses, delays, repeats and reorders messages."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing

import pytest

from aero_planner import PlannerConfig
from aero_planner.onboard.interfaces import PlanRecord
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.telemetry import Telemetry
from aero_planner.onboard.telemetry_protocol import Kind
from aero_planner.onboard.tuning import AGE_MAX, Tuning
from aero_viz.errors import UserError
from aero_viz.session.drone_tuning import DroneTuning
from aero_viz.session.live_session import LiveSession
from aero_viz.session.node_client import NodeClient
from tests.planner.onboard.simulated import SMALL
from tests.session.message_relay import MessageRelay
from tests.session.test_live_session import Watcher

KEY = bytes(range(32))
FASTER = {"vehicle.speed_limit": 6.0}
LIMITS = {"tuning.limits": "vehicle.speed_limit 1..6, costs.q_track 1..30"}


class Drone:
    """The part of a node that viewers reach; it plans when `plans` is set."""

    def __init__(self, key: bytes = KEY, **limits: str) -> None:
        onboard = OnboardConfig().replace({"telemetry.port": 0, **(limits or LIMITS)})
        self.tuning = Tuning(SMALL, onboard, key)
        self.telemetry = Telemetry(SMALL, onboard, tuning=self.tuning)
        self.configured: list[PlannerConfig] = []
        self.plans = threading.Event()
        self.plans.set()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._plan)
        self._thread.start()

    def _plan(self) -> None:
        while not self._closed.wait(0.01):
            if self.plans.is_set() and (change := self.tuning.take(self.configured.append)) is not None:
                self.telemetry.observe(change)

    def close(self) -> None:
        self._closed.set()
        self._thread.join()
        self.telemetry.close()


def until(condition: Callable[[], object]) -> None:
    end = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


@pytest.fixture
def drone() -> Iterator[Drone]:
    with closing(Drone()) as drone:
        yield drone


@pytest.fixture
def relay(drone: Drone) -> Iterator[MessageRelay]:
    with MessageRelay(drone.telemetry.port) as relay:
        yield relay


class Pilot:
    """A session with a key, and what it tells the user."""

    def __init__(self, port: int, key: bytes | None = KEY) -> None:
        def connect() -> NodeClient:
            return NodeClient("127.0.0.1", port, key=key)

        self.session = LiveSession(connect(), reconnect=connect)
        self.watcher = Watcher(self.session)
        self.session.start()

    @property
    def tuning(self) -> DroneTuning:
        return self.session.tuning

    def heard(self, text: str) -> None:
        """Wait for a notice."""
        notices = self.watcher.notices
        assert self.watcher.wait(lambda: any(text in notice.text for notice in notices)), notices
        notices.clear()

    def close(self) -> None:
        self.session.close()


@pytest.fixture
def pilot(relay: MessageRelay) -> Iterator[Pilot]:
    with closing(Pilot(relay.port)) as pilot:
        pilot.heard("has accepted the key")
        yield pilot


def test_a_change_is_pending_until_the_drone_has_taken_it(drone: Drone, pilot: Pilot, records: list[PlanRecord]):
    drone.plans.clear()
    pilot.tuning.change(FASTER, confirmed=True)
    assert pilot.tuning.state.pending == "vehicle.speed_limit 5.0 → 6.0" and pilot.session.config == SMALL
    with pytest.raises(UserError, match="has not answered yet: vehicle"):
        pilot.tuning.undo()
    drone.plans.set()
    pilot.heard("version 1: vehicle.speed_limit 5.0 → 6.0")
    state = pilot.tuning.state
    assert (state.pending, state.refused, state.version, state.can_undo, state.at_takeoff) == ("", "", 1, True, False)
    assert pilot.session.config == drone.tuning.config == drone.configured[-1] == SMALL.replace(FASTER)
    drone.telemetry.observe(records[0])
    assert pilot.watcher.wait(lambda: pilot.watcher.frames)
    frame = pilot.watcher.frames[-1]
    assert frame.config == SMALL.replace(FASTER) and frame.config_version == 1
    pilot.tuning.undo()
    pilot.heard("version 2: vehicle.speed_limit 6.0 → 5.0")
    pilot.tuning.change({"vehicle.speed_limit": 2.0, "costs.q_track": 3.0}, confirmed=True)
    pilot.heard("version 3")
    pilot.tuning.back_to_takeoff()
    pilot.heard("version 4")
    assert drone.tuning.config == SMALL


def test_a_refusal_says_why_and_changes_nothing(drone: Drone, pilot: Pilot):
    pilot.tuning.change(FASTER)  # nothing has said that the drone is disarmed
    pilot.heard("The drone has changed nothing: the drone is armed, and the change was not confirmed")
    pilot.tuning.change({"vehicle.speed_limit": 9.0}, confirmed=True)
    pilot.heard("The drone has changed nothing: vehicle.speed_limit is 9.0; it must be a number in [1, 6]")
    assert "must be a number in [1, 6]" in pilot.tuning.state.refused and not pilot.tuning.state.pending
    assert drone.configured == [] and pilot.session.config == SMALL


def test_a_lost_request_is_noticed_and_the_next_one_works(drone: Drone, pilot: Pilot, relay: MessageRelay):
    relay.to_node = lambda kind, message: []
    pilot.tuning.change(FASTER, confirmed=True)
    pilot.heard("The drone has changed nothing: it was lost on the way")
    assert drone.configured == [] and not pilot.tuning.state.pending
    relay.to_node = lambda kind, message: [message]
    pilot.tuning.change(FASTER, confirmed=True)
    pilot.heard("version 1")


def test_a_lost_answer_is_given_again(drone: Drone, pilot: Pilot, relay: MessageRelay):
    lost: list[bytes] = []
    relay.to_viewer = lambda kind, message: lost.append(message) or []
    pilot.tuning.change(FASTER, confirmed=True)
    until(lambda: drone.tuning.version and len(lost) > 3)
    assert pilot.tuning.state.pending
    relay.to_viewer = lambda kind, message: [message]
    pilot.heard("version 1")
    assert not pilot.tuning.state.pending


@pytest.mark.parametrize("is_newer_first", [False, True])
def test_a_delayed_request_changes_nothing(drone: Drone, pilot: Pilot, relay: MessageRelay, is_newer_first: bool):
    held: list[bytes] = []
    relay.to_node = lambda kind, message: held.append(message) or []
    pilot.tuning.change(FASTER, confirmed=True)
    pilot.heard("it was lost on the way")
    relay.to_node = lambda kind, message: [message]
    if is_newer_first:
        pilot.tuning.change({"costs.q_track": 9.0}, confirmed=True)
        pilot.heard("costs.q_track 5.0 → 9.0")
    before = drone.tuning.config
    relay.send_to_node(held[0])
    if is_newer_first:  # the older one comes after it
        pilot.heard("it is an old one")
    else:
        pilot.tuning.change({"costs.q_track": 9.0}, confirmed=True)
        pilot.heard("costs.q_track 5.0 → 9.0")
    assert drone.tuning.config.vehicle.speed_limit == before.vehicle.speed_limit == 5.0


def test_a_repeated_request_is_done_once_and_ends_the_right_to_change(drone: Drone, pilot: Pilot, relay: MessageRelay):
    relay.to_node = lambda kind, message: [message, message]
    pilot.tuning.change(FASTER, confirmed=True)
    pilot.heard("The node does not accept the key (a message was refused: it is an old one")
    assert len(drone.configured) <= 1
    with pytest.raises(UserError, match="connect again"):
        pilot.tuning.undo()


def test_statuses_that_are_repeated_or_forged_are_ignored(drone: Drone, pilot: Pilot, relay: MessageRelay):
    old: list[bytes] = []

    def repeat(kind: int, message: bytes) -> list[bytes]:
        if kind == Kind.STATUS:
            old.append(message)
        return [message, *old]

    relay.to_viewer = repeat
    pilot.tuning.change(FASTER, confirmed=True)
    pilot.heard("version 1")
    until(lambda: len(old) > 5)
    assert pilot.tuning.state.version == 1 and pilot.session.config == SMALL.replace(FASTER)


def test_nothing_changes_when_the_link_dies(drone: Drone, pilot: Pilot, relay: MessageRelay):
    pilot.tuning.change({"costs.q_track": 9.0}, confirmed=True)
    pilot.heard("version 1")
    drone.plans.clear()
    pilot.tuning.change(FASTER, confirmed=True)
    relay.cut()
    pilot.heard("is lost")
    until(lambda: not drone.telemetry.viewers)
    drone.plans.set()
    pilot.heard("has accepted the key")  # connected again, with nonces of its own
    assert drone.tuning.config == pilot.session.config == SMALL.replace({"costs.q_track": 9.0})
    assert pilot.tuning.state.version == 1 and not pilot.tuning.state.pending
    pilot.tuning.change(FASTER, confirmed=True)
    pilot.heard("version 2")


def test_nothing_is_sent_over_a_silent_link(pilot: Pilot, relay: MessageRelay):
    sent: list[bytes] = []
    relay.to_node = lambda kind, message: sent.append(message) or []
    relay.to_viewer = lambda kind, message: []
    time.sleep(1.2 * AGE_MAX)
    with pytest.raises(UserError, match="The link has been silent for"):
        pilot.tuning.change(FASTER, confirmed=True)
    assert sent == []


def test_a_forged_key_only_watches(drone: Drone):
    with closing(Pilot(drone.telemetry.port, bytes(32))) as pilot:
        pilot.heard("The node does not accept the key (a message was refused: it was sealed with another key")
        with pytest.raises(UserError, match="check --key"):
            pilot.tuning.change(FASTER, confirmed=True)
        assert drone.configured == []


def test_without_a_key_a_viewer_sees_the_changes_of_others(drone: Drone, pilot: Pilot):
    with closing(Pilot(drone.telemetry.port, None)) as watcher:
        with pytest.raises(UserError, match="connect with --key"):
            watcher.tuning.change(FASTER)
        pilot.tuning.change(FASTER, confirmed=True)
        pilot.heard("version 1")
        until(lambda: watcher.session.config == SMALL.replace(FASTER))


def test_a_node_that_allows_nothing_says_so(telemetry: Telemetry):
    with ExitStack() as stack:
        plain = stack.enter_context(closing(Pilot(telemetry.port)))
        bare = stack.enter_context(closing(Drone(KEY, **{"tuning.limits": "none"})))
        limited = stack.enter_context(closing(Pilot(bare.telemetry.port)))
        assert "the node has no tuning.key_file" in plain.tuning.state.obstacle
        assert "tuning.limits of the node allows nothing" in limited.tuning.state.obstacle
