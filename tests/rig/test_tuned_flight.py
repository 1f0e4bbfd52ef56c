"""A flight whose speed limit is changed from the page, in simulated time over real sockets."""

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from aero_planner import Planner, PlannerConfig
from aero_planner.onboard.failsafe_table import State
from aero_planner.onboard.settings import OnboardConfig
from aero_viz.dashboard import Dashboard
from aero_viz.dashboard.panels.drone_tuning import DroneTuningPanel
from aero_viz.dashboard.viser_private import identifier
from aero_viz.rig.lockstep import LockstepRig
from aero_viz.scenes import World
from aero_viz.sensors import LidarModel
from tests.dashboard.page_client import CAMERA, join, send, wait_for
from tests.session.test_drone_tuning import KEY, Pilot

SLOW = PlannerConfig.preset("fast-cpu").replace({"vehicle.speed_limit": 2.0})
ONBOARD = OnboardConfig().replace({"telemetry.port": 0, "tuning.limits": "vehicle.speed_limit 1..5"})


@pytest.fixture
def planner() -> Iterator[Planner]:
    with contextlib.closing(Planner(SLOW, device="cpu", threads=1)) as planner:
        yield planner


def avenue() -> World:
    posts = [[x, y, 0, 0, 0, 1, 0.3, 8] for x in range(0, 70, 4) for y in (-3.5, 3.5)]
    ground = [35.0, 0, -0.5, 160, 80, 1, 0]
    return World("avenue", np.array([0.0, 0, 2]), np.array([60.0, 0, 2]), np.array(posts), np.array([ground]))


class PageOfDrone:
    """The page, with a visitor who clicks, and the drone that flies on meanwhile."""

    def __init__(self, rig: LockstepRig, pilot: Pilot, dashboard: Dashboard, visitor: Any) -> None:
        self._rig, self._pilot, self._dashboard, self._visitor = rig, pilot, dashboard, visitor
        (self.panel,) = (panel for panel in dashboard.panels if isinstance(panel, DroneTuningPanel))

    def set(self, control: Any, value: object) -> None:
        send(self._visitor, type="GuiUpdateMessage", uuid=identifier(control), updates={"value": value})

    def wait_for(self, shows: Any) -> None:
        def is_shown() -> bool:
            self._dashboard.drain()
            return shows()

        wait_for(is_shown, "the page")

    def fly_until_taken(self, version: int, limit: float) -> None:
        """Let the drone fly until it has taken the change that is pending."""
        state, planner = self._pilot.tuning.state, self._rig.node
        assert state.pending and state.version == version - 1 and planner.state is State.FLYING
        self.wait_for(lambda: "pending" in self.panel.report.content)
        for _ in range(20):
            self._rig.run(0.1)  # the message is on its way, and waits for a tick
            if self._pilot.tuning.state.version == version:
                break
        self._pilot.heard(f"version {version}")
        assert self._pilot.session.config.vehicle.speed_limit == limit
        self.wait_for(
            lambda: "pending" not in self.panel.report.content and f">{version}<" in self.panel.report.content
        )

    def send_limit(self, limit: float) -> None:
        """Move the slider, and click twice, as the drone is armed."""
        (row,) = self.panel.rows
        self.set(row.control.handles[-1], limit)
        self.wait_for(lambda: self.panel.send.visible)
        assert self.panel.send.label == "Send to the drone" and row.control.value == limit
        self.set(self.panel.send, True)
        self.wait_for(lambda: self.panel.send.label == "The drone is armed: click again to send")
        assert not self._pilot.tuning.state.pending
        self.set(self.panel.send, True)
        self.wait_for(lambda: not self.panel.send.visible)


def mean_speed(rig: LockstepRig, seconds: float) -> float:
    """Return the mean speed of the last seconds [m/s]."""
    return float(np.mean(rig.speeds[-round(seconds * 250) :]))


def test_the_speed_limit_goes_from_2_to_5_and_back_to_2_from_the_page(planner: Planner):
    lidar = LidarModel("quarter", pattern="livox", points_per_sweep=5000)
    with contextlib.ExitStack() as stack:
        rig = stack.enter_context(LockstepRig(planner, avenue(), onboard=ONBOARD, lidar=lidar, tuning_key=KEY))
        pilot = stack.enter_context(contextlib.closing(Pilot(rig.telemetry.port)))
        pilot.heard("has accepted the key")
        dashboard = stack.enter_context(contextlib.closing(Dashboard(pilot.session, port=0)))
        visitor = stack.enter_context(join(dashboard.server))
        send(visitor, **CAMERA)
        wait_for(dashboard.server.get_clients, "the visitor")
        page = PageOfDrone(rig, pilot, dashboard, visitor)
        assert rig.take_over()
        rig.run(3.0)
        assert 1.5 < mean_speed(rig, 1.0) < 2.3
        page.send_limit(5.0)
        page.fly_until_taken(1, 5.0)
        rig.run(3.0)
        assert 3.8 < mean_speed(rig, 1.0) < 5.5
        page.set(page.panel.steps, "back to take-off")  # one click
        wait_for(lambda: pilot.tuning.state.pending, "the click")
        page.fly_until_taken(2, 2.0)
        rig.run(3.0)
        assert 1.5 < mean_speed(rig, 1.0) < 2.3
        assert planner.config.vehicle.speed_limit == 2.0
        assert not rig.collided and all(change.target is not State.BRAKING for change in rig.node.changes)
