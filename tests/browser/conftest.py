"""A real forest, a real planner, the real page in a real Chromium."""

from __future__ import annotations

import contextlib
import os
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from playwright.sync_api import Browser, Locator, Page

from aero_planner import PlannerConfig
from aero_viz.dashboard import Dashboard
from aero_viz.dashboard.panels.camera import FIELD_OF_VIEW, orientation
from aero_viz.errors import UserError
from aero_viz.flight import FlightSource
from aero_viz.scenes import scene
from aero_viz.session import Session
from aero_viz.snapshot import launch_chromium
from aero_viz.source import Source


def _open_source(spec: str) -> Source:
    return FlightSource(scene(spec, seed=2))


@dataclass
class Desk:
    """A paused session, its dashboard, and a page that shows it."""

    session: Session
    dashboard: Dashboard
    page: Page
    console: list[str] = field(default_factory=list)

    def wait_for(self, condition: Callable[[], bool], what: str, timeout: float = 20.0) -> None:
        deadline = time.monotonic() + timeout
        while not condition():
            assert time.monotonic() < deadline, f"waited {timeout} s for {what}"
            self.page.wait_for_timeout(30)

    def click(self, name: str) -> None:
        self.page.get_by_role("button", name=name, exact=True).click()

    def control(self, label: str) -> Locator:
        """The row of the panel with this label."""
        exact = self.page.locator("label", has_text=re.compile(f"^{label}$"))
        return exact.locator("xpath=ancestor::div[contains(@class, 'Flex')][1]")

    def open_tab(self, name: str) -> None:
        self.page.get_by_role("tab", name=name).click()

    def render(
        self, position: ArrayLike, look_at: ArrayLike, *, width: int = 640, height: int = 600
    ) -> NDArray[np.uint8]:
        """What the page's camera sees from there, shape [height, width, 4]; alpha is 0 where nothing is."""
        assert self.dashboard.drain()
        client = next(iter(self.dashboard.server.get_clients().values()))
        position, look_at = np.asarray(position, dtype=np.float64), np.asarray(look_at, dtype=np.float64)
        look = orientation(position, look_at)
        return client.get_render(
            height, width, wxyz=look, position=position, fov=FIELD_OF_VIEW, transport_format="png", timeout=30.0
        )


@contextlib.contextmanager
def open_desk(browser: Browser, *, ticks: int, config: PlannerConfig | None = None) -> Iterator[Desk]:
    session = Session(FlightSource(scene("forest", seed=0)), config=config)
    for _ in range(ticks):
        session.tick()
    session.start(play=False)
    dashboard = Dashboard(session, port=0, open_source=_open_source, choices=[("Verticals", "verticals")])
    context = browser.new_context(viewport={"width": 1000, "height": 600})
    page = context.new_page()
    desk = Desk(session, dashboard, page)
    page.on("console", lambda message: desk.console.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: desk.console.append(str(error)))
    try:
        page.goto(dashboard.url)
        desk.wait_for(lambda: bool(dashboard.server.get_clients()), "the page to connect")
        yield desk
    finally:
        context.close()
        dashboard.close()
        session.close()


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """Chromium; in CI a missing one is a failure."""
    with contextlib.ExitStack() as stack:
        try:
            chromium = stack.enter_context(launch_chromium())
        except UserError as error:
            if os.environ.get("CI"):
                pytest.fail(str(error))
            pytest.skip(f"NO PAGE WAS TESTED: {error}")
        yield chromium


@pytest.fixture(scope="module")
def desk(browser: Browser) -> Iterator[Desk]:
    """1 s into the forest with the literal planner of the paper: 15 instances."""
    with open_desk(browser, ticks=50, config=PlannerConfig.preset("paper")) as desk:
        yield desk


@pytest.fixture
def fresh_desk(browser: Browser) -> Iterator[Desk]:
    """A desk that a test may spoil."""
    with open_desk(browser, ticks=10) as desk:
        yield desk
