"""Telemetry of a node, for tests that watch it."""

from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.telemetry import Telemetry
from tests.planner.onboard.simulated import SMALL


class Clock:
    now = 100.0

    def __call__(self) -> float:
        self.now += 1.0  # the next plan is always due
        return self.now


def serve(port: int = 0) -> Telemetry:
    config = OnboardConfig().replace({"telemetry.port": port, "rates.replan": 25.0})
    return Telemetry(SMALL, config, clock=Clock())
