"""Fixtures for the tests of sessions."""

from collections.abc import Iterator
from contextlib import closing

import pytest

from aero_planner import Planner
from aero_planner.onboard.interfaces import PlanRecord
from aero_planner.onboard.telemetry import Telemetry
from tests.planner.onboard.conftest import Records
from tests.planner.onboard.simulated import PLACES, SMALL, Simulation, poles
from tests.session.node_telemetry import serve


@pytest.fixture(scope="module")
def records() -> list[PlanRecord]:
    """Records of the first plans of a simulated node in flight."""
    planner, seen = Planner(SMALL, seed=1), Records()
    with closing(planner):
        simulation = Simulation(planner, poles(PLACES), (18.0, 0.0, 2.0), observers=[seen])
        simulation.engage()
        simulation.run(0.8)
    return seen.plans


@pytest.fixture
def telemetry() -> Iterator[Telemetry]:
    telemetry = serve()
    yield telemetry
    telemetry.close()
