"""Notifications while a source is being opened."""

import re
import time
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser

from aero_viz.catalog import open_source
from aero_viz.reader_process import Reader, read_here
from aero_viz.session.source import Conditions, Source
from tests.browser.desk import COARSE, Desk, open_desk


def open_slowly(spec: str, /, *, seed: int, read: Reader = read_here, conditions: Conditions | None = None) -> Source:
    """Open a source after an hour."""
    read(time.sleep, 3600.0)
    return open_source(spec, seed=seed, conditions=conditions)


@pytest.fixture
def slow_desk(browser: Browser) -> Iterator[Desk]:
    """A page on which every source takes long to open."""
    with open_desk(browser, ticks=1, resolution=COARSE, layers=["drone"], opener=open_slowly) as desk:
        yield desk


def test_a_notification_tells_the_progress_until_the_opening_is_cancelled(slow_desk):
    desk = slow_desk
    before = desk.session.source
    assert not desk.page.get_by_role("button", name="Cancel opening").is_visible()
    desk.page.get_by_role("button", name="Open", exact=True).click()
    notification = desk.page.locator(".mantine-Notification-root", has_text=re.compile(r"Opening forest \.\. \d+ s"))
    notification.wait_for()
    desk.page.wait_for_timeout(1000)
    assert notification.is_visible()
    desk.click("Cancel opening")
    notification.wait_for(state="detached")
    desk.page.get_by_text("forest was not opened").first.wait_for()
    desk.page.get_by_role("button", name="Cancel opening").wait_for(state="hidden")
    assert desk.session.source is before
    assert desk.console == []
    assert desk.dashboard.failures == 0


def test_the_notification_disappears_if_a_source_cannot_be_opened(restored_desk, tmp_path):
    desk, path = restored_desk, tmp_path / "damaged.json"
    path.write_text("{")
    desk.control("Path").locator("input").fill(str(path))
    desk.click("Open path")
    desk.refusal("cannot be opened; the terminal shows why").wait_for()
    desk.page.locator(".mantine-Notification-root", has_text=f"Opening {path}").wait_for(state="detached")
