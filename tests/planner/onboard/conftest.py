import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from aero_planner import Planner
from aero_planner.onboard.interfaces import Observation, Observer, PlanRecord
from aero_planner.onboard.mavlink import MavlinkLink
from aero_planner.onboard.thrust import ThrustModel
from tests.planner.onboard.mavlink_peer import Peer
from tests.planner.onboard.simulated import PLACES, SMALL, Clock, Simulation, in_flight, poles


class Records(Observer):
    """Keeps the records of the node's plans."""

    def __init__(self) -> None:
        self.plans: list[PlanRecord] = []

    def observe(self, item: Observation) -> None:
        if isinstance(item, PlanRecord):
            self.plans.append(item)


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture(autouse=True)
def ample_poll_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a poll read all that has arrived: on a slow machine the usual processor time suffices for one datagram."""
    for module in ("mavlink", "livox"):
        monkeypatch.setattr(f"aero_planner.onboard.{module}._POLL_TIME", 60.0)


@pytest.fixture(autouse=True)
def state_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder in which the node keeps what outlasts it."""
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return tmp_path / "state" / "aero-planner"


@pytest.fixture(scope="package")
def shared_planner() -> Iterator[Planner]:
    """A planner with few samples, shared by all tests."""
    planner = Planner(SMALL, seed=2)
    yield planner
    planner.close()


@pytest.fixture
def small_planner(shared_planner: Planner) -> Planner:
    """The shared planner, without what an earlier test has changed."""
    shared_planner.configure(SMALL)
    return shared_planner


@pytest.fixture(scope="package")
def records(shared_planner: Planner) -> list[PlanRecord]:
    """Records of the first plans of a flight."""
    seen = Records()
    shared_planner.configure(SMALL)
    simulation = Simulation(shared_planner, poles(PLACES), (18.0, 0.0, 2.0), observers=[seen])
    simulation.engage()
    simulation.run(0.5)
    return seen.plans


@pytest.fixture
def flight(small_planner: Planner) -> Simulation:
    """A simulation in full flight, with short time limits and a low floor, below which braking does not end."""
    changes = {"limits.hold_time": 1.0, "limits.brake_time": 3.0, "limits.fence_height_min": 0.5}
    return in_flight(small_planner, changes=changes)


@pytest.fixture
def port() -> int:
    """A UDP port that is free."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def link(clock: Clock, port: int) -> Iterator[MavlinkLink]:
    """A link that obeys the vehicle and a ground station, whose messages may be forwarded."""
    senders = [(1, None), (255, None), (255, "127.0.0.1")]
    link = MavlinkLink(f"udpin:127.0.0.1:{port}", ThrustModel(2.0, hover_thrust=0.4), goal_senders=senders, clock=clock)
    yield link
    link.close()


@pytest.fixture
def autopilot(link: MavlinkLink, port: int) -> Iterator[Peer]:
    """The autopilot at the other end of `link`."""
    peer = Peer(port)
    yield peer
    peer.socket.close()
