"""A session that watches a drone: its history, its reconnection, and what the page shows of it."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from types import SimpleNamespace
from typing import Any

import pytest

from aero_planner.onboard.failsafe_table import Cause, State
from aero_planner.onboard.interfaces import PlanRecord
from aero_planner.onboard.safety_machine import StateChange
from aero_planner.onboard.telemetry import Telemetry
from aero_viz.dashboard import Dashboard
from aero_viz.dashboard.layers import apply
from aero_viz.dashboard.layers.drone import DroneLayer
from aero_viz.dashboard.layers.goal import GoalLayer
from aero_viz.dashboard.panels.appearance import AppearancePanel
from aero_viz.dashboard.panels.camera import CameraPanel
from aero_viz.dashboard.panels.curves import CurvePanel
from aero_viz.dashboard.panels.drone_tuning import DroneTuningPanel
from aero_viz.dashboard.panels.finder import FinderPanel
from aero_viz.dashboard.panels.layers import LayerPanel
from aero_viz.dashboard.panels.open_tabs import OpenTabs
from aero_viz.dashboard.panels.parameters import ParameterTablePanel
from aero_viz.dashboard.panels.playback import PlaybackPanel
from aero_viz.dashboard.panels.returning import ReturningVisitors
from aero_viz.dashboard.panels.shortcuts import ShortcutPanel
from aero_viz.dashboard.panels.status import StatusPanel
from aero_viz.dashboard.panels.title import TitlePanel
from aero_viz.dashboard.panels.visitors import VisitorPanel
from aero_viz.session import live_session
from aero_viz.session.frame import Frame, Notice
from aero_viz.session.live_session import LiveSession
from aero_viz.session.node_client import NodeClient
from tests.planner.onboard.simulated import SMALL
from tests.session.node_telemetry import serve


class Watcher:
    """Collects the frames and notices of a session, and waits for them."""

    def __init__(self, session: LiveSession) -> None:
        self.frames: list[Frame] = []
        self.notices: list[Notice] = []
        self._changed = threading.Condition()
        session.subscribe(lambda frame: self._add(self.frames, frame), every=True)
        session.subscribe_notices(lambda notice: self._add(self.notices, notice))

    def _add(self, items: list[Any], item: Any) -> None:
        with self._changed:
            items.append(item)
            self._changed.notify_all()

    def wait(self, condition: Callable[[], Any]) -> bool:
        with self._changed:
            return bool(self._changed.wait_for(condition, 60.0))


@contextmanager
def watch(port: int) -> Iterator[tuple[LiveSession, Watcher]]:
    """Open a live session of the node at `port`, which reconnects."""
    with closing(
        LiveSession(NodeClient("127.0.0.1", port), reconnect=lambda: NodeClient("127.0.0.1", port))
    ) as session:
        watcher = Watcher(session)
        session.start()
        yield session, watcher


@pytest.fixture
def live(telemetry: Telemetry) -> Iterator[tuple[LiveSession, Watcher]]:
    with watch(telemetry.port) as session_and_watcher:
        yield session_and_watcher


def restart(telemetry: Telemetry, watcher: Watcher) -> Telemetry:
    """Close the node's telemetry and serve it again at the same port; return it once the session has reconnected."""
    telemetry.close()
    assert watcher.wait(lambda: any("is lost" in notice.text for notice in watcher.notices))
    restarted = serve(telemetry.port)
    assert watcher.wait(lambda: any("connected again" in notice.text for notice in watcher.notices))
    return restarted


def show(telemetry: Telemetry, watcher: Watcher, records: list[PlanRecord]) -> None:
    """Send plans, each after the previous one has been shown."""
    for record in records:
        telemetry.observe(record)
        assert watcher.wait(lambda number=record.number: watcher.frames and watcher.frames[-1].index == number)


def send(telemetry: Telemetry, watcher: Watcher, records: list[PlanRecord]) -> None:
    """Send plans to a paused session, and wait until it has received them."""
    for record in records:
        sent = telemetry.sent
        telemetry.observe(record)
        while telemetry.sent == sent:
            time.sleep(0.001)
    count = len(watcher.notices)
    telemetry.observe(StateChange(1.0, State.READY, State.FLYING, Cause.ENGAGED))
    assert watcher.wait(lambda: len(watcher.notices) > count)  # the session receives messages in order


def test_a_live_session_follows_pauses_and_steps_back(
    telemetry: Telemetry, live: tuple[LiveSession, Watcher], records: list[PlanRecord]
):
    session, watcher = live
    show(telemetry, watcher, records[:5])
    assert session.playing and session.frame is not None and session.frame.index == records[4].number
    states: list[bool] = []
    sink = session.subscribe_playing(states.append)
    session.pause()
    assert sink.drain() and states == [True, False]
    telemetry.observe(records[5])
    while session.time_range[1] <= session.frame.time:  # received and not shown
        time.sleep(0.01)
    assert session.frame.index == records[4].number
    session.step(-2)
    assert session.frame.index == records[2].number and session.frame.epoch == 1
    session.step(100)
    assert session.frame.index == records[5].number
    first, last = session.time_range
    session.seek((first + last) / 2)
    assert first < session.frame.time < last
    session.seek(-1e9)
    assert session.frame.time == first
    session.play()
    assert session.playing and session.frame.index == records[5].number


def test_a_long_pause_keeps_the_frames_around_it(
    telemetry: Telemetry, live: tuple[LiveSession, Watcher], records: list[PlanRecord], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(live_session, "_KEPT", 3)
    session, watcher = live
    numbers = [record.number for record in records]
    show(telemetry, watcher, records[:5])
    session.pause()
    send(telemetry, watcher, records[5:])
    visited = []
    for step in (0, -1, -1, -1, 1, 1, 1, 1, 1, 1, 1):
        session.step(step)
        assert session.frame is not None
        visited.append(session.frame.index)
    kept = numbers[2:8]  # three up to the pause and three after it
    assert visited == [kept[i] for i in (2, 1, 0, 0, 1, 2, 3, 4, 5, 5, 5)]
    session.play()
    assert session.frame is not None and session.frame.index == numbers[-1]
    session.step(-1)  # frames from before the gap are gone
    assert session.frame.index == numbers[-1]


def test_a_pause_survives_a_reconnection(records: list[PlanRecord]):
    first = serve()
    with watch(first.port) as (session, watcher):
        show(first, watcher, records[:4])
        session.pause()
        with closing(restart(first, watcher)) as second:
            send(second, watcher, records[:2])  # a restarted node numbers its plans from the beginning
            session.step(-1)
            held = session.frame
            assert held is not None and held.index == records[2].number
            session.play()
            assert session.frame is not None and session.frame.index == records[1].number
            assert session.frame.epoch > held.epoch and session.frame.source is not held.source


def test_the_age_of_the_newest_plan_is_shown_once_plans_stop_coming(
    telemetry: Telemetry, live: tuple[LiveSession, Watcher], records: list[PlanRecord], monkeypatch: pytest.MonkeyPatch
):
    now = 100.0
    monkeypatch.setattr(live_session, "time", SimpleNamespace(monotonic=lambda: now))  # a test may be late itself
    session, watcher = live
    show(telemetry, watcher, records[:2])
    fresh = watcher.frames[-1]
    assert fresh.explanation is not None and fresh.rate > 0.0
    now += 2.0
    assert watcher.wait(lambda: watcher.frames[-1].explanation != fresh.explanation)
    assert watcher.frames[-1].explanation == f"{fresh.explanation} The newest plan is 2 s old."
    assert watcher.frames[-1].rate == 0.0 and watcher.frames[-1].index == fresh.index
    assert watcher.frames[-1].epoch == fresh.epoch
    session.pause()
    send(telemetry, watcher, records[2:3])
    assert watcher.wait(lambda: watcher.frames[-1].explanation == fresh.explanation)
    assert session.frame is not None and session.frame.index == fresh.index


def test_a_live_session_has_no_controls_and_the_page_offers_none(live: tuple[LiveSession, Watcher]):
    session, _ = live
    assert session.controls is None
    assert session.speed == 1.0 and session.config == SMALL
    with closing(Dashboard(session, port=0)) as dashboard:
        offered = {type(panel) for panel in dashboard.panels}
        assert offered == {
            AppearancePanel,
            PlaybackPanel,
            CameraPanel,
            CurvePanel,
            DroneTuningPanel,
            FinderPanel,
            LayerPanel,
            OpenTabs,
            ParameterTablePanel,
            ReturningVisitors,
            ShortcutPanel,
            StatusPanel,
            TitlePanel,
            VisitorPanel,
        }
        assert not any(layer.needs_samples for layer in dashboard.layers.values()), "the drone sends no samples"


def test_safety_state_transitions_become_notices(live: tuple[LiveSession, Watcher], telemetry: Telemetry):
    _, watcher = live
    telemetry.observe(StateChange(1.0, State.FLYING, State.BRAKING, Cause.CLOUD_STALE))
    assert watcher.wait(lambda: watcher.notices)
    assert watcher.notices[0] == Notice("error", f"FLYING → BRAKING: {Cause.CLOUD_STALE.value}")


def test_a_live_session_reconnects_to_a_lost_drone(records: list[PlanRecord]):
    first = serve()
    with watch(first.port) as (_, watcher):
        show(first, watcher, records[:2])
        with closing(restart(first, watcher)) as second:
            show(second, watcher, records[2:4])
        assert watcher.frames[-1].epoch > watcher.frames[0].epoch


def test_closing_does_not_wait_for_an_attempt_to_reconnect(telemetry: Telemetry):
    attempted, released, gave_up = threading.Event(), threading.Event(), []
    late = NodeClient("127.0.0.1", telemetry.port)

    def reconnect() -> NodeClient:
        attempted.set()
        if not released.wait(4.0):
            gave_up.append(True)
        return late

    first = NodeClient("127.0.0.1", telemetry.port)
    session = LiveSession(first, reconnect=reconnect)
    session.start()
    first.close()
    assert attempted.wait(60.0)
    session.close()
    assert gave_up == []
    released.set()
    assert list(late) == [], "it was closed, as nobody uses it"


def test_the_dashboard_shows_a_live_session(
    live: tuple[LiveSession, Watcher], telemetry: Telemetry, records: list[PlanRecord]
):
    session, watcher = live
    with closing(Dashboard(session, port=0)) as dashboard:
        show(telemetry, watcher, records[:3])
        frame = session.frame
        assert frame is not None
        changes = dashboard.changes(frame)
        assert len(changes) > 20 and dashboard.drain() and dashboard.failures == 0
        shown = [str(value) for handle, name, value in changes if name == "content"]
        assert any("FLYING" in text or "READY" in text for text in shown)
        assert any("controls nothing" in text for text in shown)


def test_before_its_first_plan_a_drone_is_shown_as_connected(
    live: tuple[LiveSession, Watcher], telemetry: Telemetry, records: list[PlanRecord]
):
    session, watcher = live
    with closing(Dashboard(session, port=0)) as dashboard:
        assert dashboard.drain()
        (status,) = (panel for panel in dashboard.panels if isinstance(panel, StatusPanel))
        assert f"Connected to 127.0.0.1:{telemetry.port}, which has not planned yet" in status.html.content
        placed = [x.pose for x in dashboard.layers.values() if isinstance(x, GoalLayer | DroneLayer)]
        assert not any(pose.visible for pose in placed), "their positions are not known yet"
        (playback,) = (panel for panel in dashboard.panels if isinstance(panel, PlaybackPanel))
        assert playback.pause_button.visible and not playback.play_button.visible
        session.pause()
        assert dashboard.drain() and playback.play_button.visible and not playback.pause_button.visible
        session.play()
        show(telemetry, watcher, records[:1])
        frame = session.frame
        assert frame is not None
        apply(dashboard.changes(frame))
        assert all(pose.visible for pose in placed) and "has not planned yet" not in status.html.content


def test_a_drone_lost_before_its_first_plan_is_not_shown_as_connected():
    telemetry = serve()
    session = LiveSession(NodeClient("127.0.0.1", telemetry.port))
    watcher = Watcher(session)
    session.start()
    telemetry.close()
    assert watcher.wait(lambda: any("is lost" in notice.text for notice in watcher.notices))
    assert "was lost" in session.waiting_message and "Connected" not in session.waiting_message
    session.close()
