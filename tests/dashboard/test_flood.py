"""Thousands of clicks while the session is busy."""

import threading
from collections.abc import Iterator
from concurrent.futures import Future
from types import SimpleNamespace
from typing import Any

import pytest
from small_source import small_config, small_source

from aero_viz.dashboard import Dashboard
from aero_viz.dashboard.viser_private import identifier, inputs
from aero_viz.flight import FlightSource
from aero_viz.planners import Plan
from aero_viz.session import Observation, Session
from tests.dashboard.page_client import CAMERA, join, send, wait_for

CLICKS = 2000


class CountingSession(Session):
    """A session that counts what it is asked to do."""

    pins = plays = 0

    def pin(self) -> Future[Any]:
        self.pins += 1
        return super().pin()

    def play(self) -> None:
        self.plays += 1
        super().play()


class BlockingFlight(FlightSource):
    """A flight whose ticks wait for an event, and are counted."""

    may_advance = threading.Event()
    advances = observations = 0

    def advance(self, plan: Plan) -> None:
        self.may_advance.wait()
        self.advances += 1
        super().advance(plan)

    def observe(self) -> Observation:
        self.observations += 1
        return super().observe()


@pytest.fixture
def desk() -> Iterator[SimpleNamespace]:
    """A paused session that is busy with a tick, and a client of its page."""
    BlockingFlight.may_advance.clear()
    source = small_source(kind=BlockingFlight, goal=40.0)
    assert isinstance(source, BlockingFlight)
    session = CountingSession(source, config=small_config())
    session.start(play=False)
    session.step(0).result()
    dashboard = Dashboard(session, port=0)
    with join(dashboard.server) as client:
        send(client, **CAMERA)
        wait_for(dashboard.server.get_clients, "the client")
        desk = SimpleNamespace(dashboard=dashboard)
        wait_for(lambda: control(desk, "Ground grid"), "the client's own controls")
        busy = session.step(1)
        yield SimpleNamespace(session=session, dashboard=dashboard, client=client, source=source, busy=busy)
        source.may_advance.set()
    dashboard.close()
    session.close()


def control(desk: SimpleNamespace, label: str) -> Any:
    server = desk.dashboard.server
    scopes = (server.gui, *(client.gui for client in server.get_clients().values()))
    controls = [control for gui in scopes for control in list(inputs(gui).values())]
    return next((control for control in controls if control.label == label), None)


def set_control(desk: SimpleNamespace, label: str, value: object) -> None:
    send(desk.client, type="GuiUpdateMessage", uuid=identifier(control(desk, label)), updates={"value": value})


def release(desk: SimpleNamespace) -> None:
    """Let the session tick once all clicks have arrived, and wait until it is idle."""
    set_control(desk, "Drag the goal", True)
    wait_for(lambda: control(desk, "Drag the goal").value, "all clicks")
    desk.source.may_advance.set()
    desk.busy.result(timeout=60.0)
    desk.session.step(0).result(timeout=60.0)


def test_waiting_steps_add_up_to_one_second_at_most(desk):
    for _ in range(CLICKS):
        set_control(desk, "Step", "+10")
    release(desk)
    wait_for(lambda: desk.source.advances > 1, "the steps")
    desk.session.step(0).result(timeout=60.0)
    assert desk.source.advances <= 1 + 50 + 50, "those that wait for the busy tick, and those that came later"


def test_of_waiting_jumps_only_the_last_is_made(desk):
    before = desk.source.observations
    for _ in range(CLICKS):
        set_control(desk, "Restart", True)
    release(desk)
    wait_for(lambda: desk.session.frame.time == 0.0, "the start")
    assert desk.source.observations <= before + 4


def test_a_layer_that_is_switched_many_times_is_planned_once(desk):
    before, samples = desk.source.observations, desk.dashboard.layers["samples"]
    for _ in range(CLICKS // 2):
        set_control(desk, samples.title, True)
        set_control(desk, samples.title, False)
    set_control(desk, samples.title, True)
    release(desk)
    assert desk.source.observations <= before + 3
    assert desk.session.frame.plan.samples is not None


def test_a_flood_of_clicks_becomes_few_commands_and_hides_no_other_click(desk):
    for _ in range(CLICKS):
        set_control(desk, "Compare: pin as A", True)
    set_control(desk, "Play", True)
    wait_for(lambda: desk.session.plays, "the click after the flood")
    assert desk.session.plays == 1
    assert desk.session.pins <= CLICKS // 10, "those that fit before the session was busy, and those that wait for it"
    release(desk)


def test_a_click_on_pause_that_arrives_when_the_session_is_paused_does_not_resume_it(desk):
    set_control(desk, "Pause", True)
    release(desk)
    assert desk.session.plays == 0 and not desk.session.playing


def test_of_a_flood_of_values_few_are_handled_and_the_last_is_kept(desk):
    number, handled = desk.dashboard.server.gui.add_number("Number", 0), []

    @number.on_update
    async def _(_: object) -> None:
        handled.append(number.value)

    for value in range(1, CLICKS + 1):
        set_control(desk, "Number", value)
    set_control(desk, "Play", True)
    wait_for(lambda: desk.session.plays, "the click after the flood")
    assert handled[-1] == CLICKS, "values that wait are handled before a click"
    assert len(handled) <= CLICKS // 10
    for value in range(CLICKS):
        set_control(desk, "Number", value)
    desk.source.may_advance.set()
    wait_for(lambda: handled[-1] == CLICKS - 1, "the value that nothing follows")
