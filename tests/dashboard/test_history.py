"""Rows, events and forks of a flight's history."""

import dataclasses
import re

import numpy as np
import pytest
from small_source import small_config, small_source

from aero_planner import PlannerConfig, PlanStatus
from aero_viz.dashboard.history import COLUMNS, FlightHistory, first_difference
from aero_viz.dashboard.panels.flight_table import flight_table
from aero_viz.dashboard.signals import drone_clearance
from aero_viz.logs.flight_figures import CLEARANCE_MAX, FlightFigures
from aero_viz.session import Session


@pytest.fixture
def session():
    session = Session(small_source(), config=small_config())
    yield session
    session.close()


def fly(session: Session, history: FlightHistory, ticks: int) -> None:
    for _ in range(ticks):
        history.add(session.tick())


def test_every_tick_has_a_row_and_going_back_keeps_them(session):
    history = FlightHistory()
    fly(session, history, 20)
    flown = history.past().rows
    assert len(flown) == 20 and tuple(history.past().columns)[: len(COLUMNS)] == COLUMNS
    np.testing.assert_allclose(np.diff(flown[:, 0]), session.source.period)
    session.step(-10)
    history.add(session.frame)
    session.seek(0.1).result()
    history.add(session.frame)
    np.testing.assert_array_equal(history.past().rows[:, 0], flown[:, 0])
    assert not len(history.past().ghost)


def test_the_same_flight_again_is_no_fork_and_another_weight_is_one(session):
    history = FlightHistory()
    fly(session, history, 30)
    flown = history.past().rows
    session.seek(float(flown[9, 0])).result()
    history.add(session.frame)
    fly(session, history, 5)
    past = history.past()
    assert len(past.ghost) == 20 and past.differs_at is None
    session.seek(float(flown[9, 0])).result()
    history.add(session.frame)
    session.configure({"costs.q_track": 50.0, "vehicle.speed_limit": 1.0})
    history.add(session.frame)
    fly(session, history, 10)
    past = history.past()
    assert past.differs_at is not None and flown[9, 0] < past.differs_at <= flown[14, 0]
    assert [event.kind for event in past.events if event.kind != "braking"] == ["parameters"]
    assert "Guide tracking weight" in past.events[0].text and "50" in past.events[0].text


def test_changes_at_one_tick_are_one_event_with_the_net_change(session):
    history = FlightHistory()
    fly(session, history, 3)
    before = session.config

    def changes(**values: float) -> list[str]:
        session.configure({path.replace("__", "."): value for path, value in values.items()})
        history.add(session.frame)
        return [event.text for event in history.past().events if event.kind == "parameters"]

    limit = f"Speed limit [m/s]: {before.vehicle.speed_limit:g} → "
    assert changes(vehicle__speed_limit=3.123456789) == [f"{limit}3.1235"]
    assert len(changes(costs__height_max=21.461567003384317)) == 1
    assert changes(costs__height_max=before.costs.height_max) == [f"{limit}3.1235"]
    assert changes(vehicle__speed_limit=before.vehicle.speed_limit) == []
    fly(session, history, 1)
    assert changes(vehicle__speed_limit=2.0) == [f"{limit}2"]
    session.configure(PlannerConfig.preset("paper"))
    history.add(session.frame)
    assert re.search(r"; \d+ more parameters$", history.past().events[-1].text)


def figures(table: str, label: str) -> list[float]:
    """Return the figures of the ghost and of the flight in a row of the table."""
    cells = re.sub("<[^>]*>", " ", table[table.index(label) + len(label) :]).split()
    return [float(cell) for cell in cells[:2]]


def test_the_table_compares_both_flights_from_their_start(session):
    history = FlightHistory()
    fly(session, history, 30)
    flown = history.past().rows
    session.seek(float(flown[20, 0])).result()
    history.add(session.frame)
    fly(session, history, 9)
    assert len(history.past().ghost) == 9
    shown = flight_table(history.past(), ("before", "now"))
    for label in ("time [s]", "length [m]", "mean speed [m/s]", "smallest clearance [m]"):
        before, now = figures(shown, label)
        assert before == now != 0.0, label


def test_ticks_without_a_safe_candidate_are_those_of_the_planner(session):
    history = FlightHistory()
    fly(session, history, 3)
    braking = dataclasses.replace(session.frame.plan, status=PlanStatus.NO_SAFE_CANDIDATE)
    last = session.frame
    history.add(dataclasses.replace(last, time=last.time + last.source.period, plan=braking))
    columns = {name: history.past().column(name) for name in COLUMNS}
    assert (history.past().column("clear") > 0.0).all(), "every plan has candidates with the safe clearance"
    assert FlightFigures.from_columns(columns, "flying").unsafe_ticks == 1


def test_a_fork_keeps_the_outcome_of_the_future_that_was_left(session):
    history = FlightHistory()
    while session.frame is None or session.frame.outcome is None:
        fly(session, history, 1)
    end = session.frame
    assert [event.kind for event in history.past().events][-1] == "arrived"
    session.seek(0.2).result()
    history.add(session.frame)
    session.set_goal(np.add(end.observation.goal.position, (0.0, 0.5, 0.0))).result()
    history.add(session.frame)
    fly(session, history, 3)
    past = history.past()
    assert past.ghost_outcome == end.outcome and past.ghost[-1, 0] == pytest.approx(end.time)
    assert [event.kind for event in past.events] == ["goal"]


def test_another_source_starts_a_new_history(session):
    history = FlightHistory()
    fly(session, history, 5)
    session.set_source(small_source()).result()
    history.add(session.frame)
    assert len(history.past().rows) == 1


def test_clearance_is_the_true_one_up_to_its_limit(session):
    frame = session.tick()
    position = np.asarray(frame.observation.actual_state.position)
    exact = float(frame.source.world.distance(position[None])[0])
    assert drone_clearance(frame) == pytest.approx(min(exact, CLEARANCE_MAX))
    assert exact > frame.config.costs.distance_max, "beyond what the planner measures"


def test_the_flight_of_a_is_the_ghost_until_it_is_unpinned(session):
    history = FlightHistory()
    events = session.comparison.subscribe(history.compare, name="history")
    fly(session, history, 5)
    session.pin().result()
    session.configure({"vehicle.speed_limit": 1.0})
    session.fly_both().result()
    history.add(session.frame)
    assert events.drain()
    past = history.past()
    assert past.ghost_name == "A" and past.ghost_outcome == "arrived"
    assert past.ghost[0, 0] == session.frame.time and past.differs_at is None
    fly(session, history, 5)
    past = history.past()
    assert past.ghost[0, 0] < past.differs_at <= past.rows[-1, 0]
    session.seek(float(past.rows[6, 0])).result()
    history.add(session.frame)
    fly(session, history, 2)
    assert len(history.past().ghost) == len(past.ghost), "a fork of B leaves the flight of A"
    assert events.drain()
    session.unpin().result()
    assert events.drain()
    assert not len(history.past().ghost) and history.past().pinned is None


def test_the_figures_of_a_stay_when_b_goes_back_beyond_the_fork(session):
    history = FlightHistory()
    events = session.comparison.subscribe(history.compare, name="history")
    fly(session, history, 20)
    session.pin().result()
    session.fly_both().result()
    assert events.drain()
    fly(session, history, 1)
    labels = ("time [s]", "length [m]", "mean speed [m/s]", "ticks without safe candidate")
    shown = flight_table(history.past(), ("A", "B"))
    a = [figures(shown, label)[0] for label in labels]
    assert a[1] / a[0] == pytest.approx(a[2], rel=0.05) and a[3] == 0.0
    session.seek(0.1).result()
    history.add(session.frame)
    for _ in range(5):
        plan = dataclasses.replace(session.tick().plan, status=PlanStatus.NO_SAFE_CANDIDATE)
        history.add(dataclasses.replace(session.frame, plan=plan))
    shown = flight_table(history.past(), ("A", "B"))
    assert figures(shown, labels[3])[1] == 5.0, "B"
    assert a == [figures(shown, label)[0] for label in labels]


def test_the_first_difference_is_that_of_positions_or_of_chosen_instances():
    rows = np.zeros((6, len(COLUMNS)))
    rows[:, 0] = np.arange(6) * 0.1
    ghost = rows[2:5].copy()
    assert first_difference(rows, ghost, has_ended=False) is None
    assert first_difference(rows, ghost, has_ended=True) == pytest.approx(0.5), "the flight goes on beyond its end"
    ghost[1, -1] = 0.01
    assert first_difference(rows, ghost, has_ended=True) == pytest.approx(0.3)
    ghost[2, COLUMNS.index("best")] = 3.0
    assert first_difference(rows, ghost, has_ended=True, plans=True) == pytest.approx(0.4)
    assert first_difference(rows, ghost[:0], has_ended=True) is None
