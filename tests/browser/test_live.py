"""The page of a live stream: its topics, holding the picture while it is recorded, and the way back to now."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page

from aero_viz.catalog import open_source, shipped_recordings
from aero_viz.dashboard import Dashboard
from aero_viz.dashboard.panels.live import LiveOffer
from aero_viz.live.player import Player
from aero_viz.live.session import StreamSession
from aero_viz.live.setup import Wanted, find_setup
from aero_viz.live.source import StreamSource
from aero_viz.live.stream import Stream
from tests.browser.desk import COARSE, TIMEOUT, visit


def wait_until(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + TIMEOUT
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.fixture
def live(tmp_path: Path) -> Iterator[tuple[StreamSession, Dashboard]]:
    """A recorded flight that arrives live, on a page."""
    (recording, _) = next(iter(shipped_recordings().values()))
    with ExitStack() as stack:
        stream = Stream("drone")
        stack.callback(Player(stream, recording).close)
        wait_until(lambda: "/sweep" in stream.topics and stream.topics["/sweep"].count > 5)
        session = StreamSession(StreamSource(stream, find_setup(stream, Wanted()), rate=10.0))
        stack.callback(session.close)
        session.tick()
        dashboard = Dashboard(session, port=0, live=LiveOffer(tmp_path), layers=[])
        stack.callback(dashboard.close)
        session.start()
        yield session, dashboard


def press(page: Page, name: str) -> None:
    page.get_by_role("button", name=name, exact=True).click()


def test_the_stream_goes_on_and_is_recorded_while_the_picture_is_held(
    live: tuple[StreamSession, Dashboard], browser: Browser, tmp_path: Path
):
    session, dashboard = live
    with visit(browser, dashboard.url, resolution=COARSE) as page:
        page.get_by_role("tab", name="Live", exact=True).click()
        page.get_by_text("poses from /odometry").first.wait_for()
        press(page, "Record")
        wait_until(lambda: session.recorder is not None and session.recorder.ticks > 2)
        press(page, "Pause")
        wait_until(lambda: not session.playing)
        held = session.frame
        recorder = session.recorder
        assert held is not None and recorder is not None
        before = recorder.ticks
        wait_until(lambda: recorder.ticks > before + 3)
        assert session.frame is held
        press(page, "-1")
        wait_until(lambda: session.frame is not None and session.frame.index < held.index)
        press(page, "Stop recording")
        page.get_by_text("aero-viz play").first.wait_for()
        press(page, "Now")
        wait_until(lambda: session.frame is not None and session.frame.time > held.time)
    source = open_source(str(tmp_path / "live.mcap"))
    assert source.info.times is not None and len(source.info.times) == recorder.ticks
    source.close()
