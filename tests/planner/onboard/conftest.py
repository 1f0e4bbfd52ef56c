from collections.abc import Iterator

import pytest

from aero_planner import Planner
from aero_planner.onboard.interfaces import Observation, Observer, PlanRecord
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


@pytest.fixture(scope="package")
def small_planner() -> Iterator[Planner]:
    """A planner with few samples, shared by all tests."""
    planner = Planner(SMALL, seed=2)
    yield planner
    planner.close()


@pytest.fixture(scope="package")
def records(small_planner: Planner) -> list[PlanRecord]:
    """Records of the first plans of a flight."""
    seen = Records()
    simulation = Simulation(small_planner, poles(PLACES), (18.0, 0.0, 2.0), observers=[seen])
    simulation.engage()
    simulation.run(0.5)
    return seen.plans


@pytest.fixture
def flight(small_planner: Planner) -> Simulation:
    """A simulation in full flight, with short time limits and a low floor, below which braking does not end."""
    changes = {"limits.hold_time": 1.0, "limits.brake_time": 3.0, "limits.fence_height_min": 0.5}
    return in_flight(small_planner, changes=changes)
