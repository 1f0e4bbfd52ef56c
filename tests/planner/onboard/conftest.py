from __future__ import annotations

from collections.abc import Iterator

import pytest

from aero_planner import Planner
from aero_planner.onboard.observer import Observer, PlanRecord
from tests.planner.onboard.simulated import PLACES, SMALL, Simulation, in_flight, poles


class Records(Observer):
    """Keeps what the node tells of its plans."""

    def __init__(self) -> None:
        self.plans: list[PlanRecord] = []

    def plan(self, record: PlanRecord) -> None:
        self.plans.append(record)


@pytest.fixture(scope="package")
def small_planner() -> Iterator[Planner]:
    """A planner with few samples, for all tests."""
    planner = Planner(SMALL, seed=1)
    yield planner
    planner.close()


@pytest.fixture(scope="package")
def records(small_planner: Planner) -> list[PlanRecord]:
    """What a node in flight tells of its first plans."""
    seen = Records()
    simulation = Simulation(small_planner, poles(PLACES), (18.0, 0.0, 2.0), observers=[seen])
    simulation.engage()
    simulation.run(0.5)
    return seen.plans


@pytest.fixture
def flight(small_planner: Planner) -> Simulation:
    """In full flight, with little patience."""
    return in_flight(small_planner, changes={"limits.hold_time": 1.0, "limits.brake_time": 3.0})
