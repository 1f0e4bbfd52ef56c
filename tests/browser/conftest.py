"""Pages of a flight through the forest, in a real Chromium."""

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser

from aero_planner import PlannerConfig
from tests.browser.desk import COARSE, Desk, open_desk, quick_forest


@pytest.fixture(scope="session")
def desk(browser: Browser) -> Iterator[Desk]:
    """1 s into the forest with the literal planner of the paper, of 15 instances. Tests choose the layers they need."""
    config = PlannerConfig.preset("paper")
    with open_desk(browser, ticks=50, config=config, resolution=COARSE, layers=["drone"]) as desk:
        yield desk


@pytest.fixture(scope="session")
def quick_desk(browser: Browser) -> Iterator[Desk]:
    """A paused flight through the forest of which only the drone is visible, which is quick to draw.

    It is one for all tests, since a page takes three seconds of processor time to open.
    """
    with open_desk(browser, quick_forest(), ticks=10, resolution=COARSE, layers=["drone"]) as desk:
        yield desk


@pytest.fixture
def restored_desk(quick_desk: Desk) -> Iterator[Desk]:
    """0.2 s into the forest, on a page that many tests share; see `Desk.restore` for what they share."""
    quick_desk.restore()
    yield quick_desk
    quick_desk.session.pause()  # the tests of other modules do not pay for a flight that goes on


@pytest.fixture
def fresh_desk(browser: Browser) -> Iterator[Desk]:
    """0.2 s into the forest, for a test that needs or changes what `Desk.restore` leaves as it is."""
    with open_desk(browser, quick_forest(), ticks=10, resolution=COARSE, layers=["drone"]) as desk:
        yield desk
