"""A pinned configuration, A, beside the session's own, B: the same tick, the same flight, and no cost while playing."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from ensemble_plans import plan_of
from small_source import small_config, small_source, wait_for

from aero_viz.errors import UserError
from aero_viz.session import Session
from aero_viz.session.comparison import ComparisonEvent

SLOW = {"vehicle.speed_limit": 2.0}


@pytest.fixture
def session() -> Iterator[Session]:
    session = Session(small_source(goal=8.0), config=small_config(), seed=3)
    yield session
    session.close()


def listen(session: Session) -> list[ComparisonEvent]:
    events: list[ComparisonEvent] = []
    session.comparison.subscribe(events.append, name="test")
    return events


def has_arrived(events: list[ComparisonEvent]) -> bool:
    return bool(events) and events[-1].frame is not None and events[-1].frame.outcome is not None


def test_nothing_is_planned_twice_until_a_configuration_is_pinned(session):
    events = listen(session)
    for _ in range(5):
        session.tick()
    assert not session.comparison.has_work and session.comparison.frame is None
    session.pin().result()
    wait_for(lambda: [event.kind for event in events] == ["pinned", "planned"])


def test_both_plan_the_same_tick_and_agree_until_b_changes(session):
    for _ in range(8):
        session.tick()
    session.pin().result()
    a, b = session.comparison.frame, session.frame
    assert a.observation is b.observation and a.config is b.config
    np.testing.assert_array_equal(a.plan.controls, b.plan.controls)
    session.configure(SLOW)
    assert session.comparison.frame is a, "A stays as it is"
    assert session.frame.config.vehicle.speed_limit == 2.0
    assert not np.array_equal(a.plan.controls, session.frame.plan.controls)
    session.step(-3).result()
    assert session.comparison.frame.time == session.frame.time
    assert not np.array_equal(session.comparison.frame.plan.controls, session.frame.plan.controls)


def test_a_flies_as_the_session_itself_would_and_leaves_it_where_it_is(session):
    for _ in range(8):
        session.tick()
    alone = Session(small_source(goal=8.0), config=small_config(), seed=3)
    frame = alone.tick()
    expected = [frame]
    while frame.outcome is None:
        expected.append(frame := alone.tick())
    alone.close()

    events = listen(session)
    session.pin().result()
    session.configure(SLOW)
    before = session.frame
    session.fly_both().result()
    wait_for(lambda: session.playing)
    assert session.frame is before, "the session has not moved"
    wait_for(lambda: has_arrived(events))
    flown: list[Any] = [event.frame for event in events if event.kind == "flown"]
    assert [frame.time for frame in flown] == pytest.approx([frame.time for frame in expected[7:]])
    for mine, theirs in zip(flown, expected[7:], strict=True):
        np.testing.assert_array_equal(mine.observation.state.position, theirs.observation.state.position)
        np.testing.assert_array_equal(plan_of(mine).controls, plan_of(theirs).controls)
    assert flown[-1].outcome == expected[-1].outcome == "arrived"
    again = session.tick()
    assert again.index == before.index + 1 and again.config.vehicle.speed_limit == 2.0


def test_a_rests_while_the_session_plays(session):
    session.start(play=False)
    wait_for(lambda: session.frame is not None)
    events = listen(session)
    session.pin().result()
    wait_for(lambda: [event.kind for event in events] == ["pinned", "planned"])
    events.clear()
    session.play()
    wait_for(lambda: session.frame.index > 10)
    session.pause()
    session.step(0).result()
    kept = session.frame
    wait_for(lambda: session.comparison.frame.time == kept.time)
    wait_for(lambda: len(events) == 1)
    assert [event.kind for event in events] == ["planned"], "one plan in the pause, none while time ran"


def test_another_structure_can_be_compared(session):
    for _ in range(3):
        session.tick()
    session.compare_with(small_config().replace({"sampling.samples": 8, "sampling.steps": 20})).result()
    a, b = session.comparison.frame, session.frame
    assert a.plan.stage1_cost.shape[1] == 16 and b.plan.stage1_cost.shape[1] == 8
    session.compare_with(small_config().replace(SLOW)).result()
    assert session.comparison.frame is a, "a candidate replaces B, not A"
    session.unpin().result()
    assert session.comparison.frame is None and not session.comparison.has_work


def test_flying_both_without_a_pin_or_at_the_end_says_what_to_do(session):
    session.tick()
    with pytest.raises(UserError, match="Pin a configuration"):
        session.fly_both().result()
    while session.tick().outcome is None:
        pass
    session.pin().result()
    with pytest.raises(UserError, match="Go back"):
        session.fly_both().result()


def test_another_source_ends_the_flight_of_a(session):
    session.start(play=False)
    wait_for(lambda: session.frame is not None)
    session.pin().result()
    session.fly_both().result()
    session.set_source(small_source(goal=9.0)).result()
    wait_for(lambda: not session.comparison.has_work and session.comparison.frame is not None)
    assert not session.comparison.is_flying
    assert session.comparison.frame.source is session.source


def test_a_learns_what_is_known_about_another_source_as_b_does(session):
    session.start(play=False)
    wait_for(lambda: session.frame is not None)
    session.pin().result()
    a = session.comparison.pinned
    session.configure(SLOW)
    top = {"costs.height_max": 5.0}
    session.set_source(small_source(goal=9.0), convert=lambda config: config.replace(top)).result()
    assert session.comparison.pinned == a.replace(top) and session.config == a.replace({**SLOW, **top})
    wait_for(lambda: session.comparison.frame is not None)
    assert session.comparison.frame.config == a.replace(top)


def test_a_stays_where_it_contradicts_what_is_known(session):
    session.tick()
    session.pin().result()
    a = session.comparison.pinned
    below = {"costs.height_max": -1e6}
    session.set_source(small_source(goal=9.0), convert=lambda config: config.replace(below)).result()
    assert session.comparison.pinned is a and session.config is a


def test_a_flies_through_a_source_that_was_chosen_while_time_ran(session):
    events = listen(session)
    session.start(play=False)
    wait_for(lambda: session.frame is not None)
    session.pin().result()
    session.play()
    session.set_source(small_source(goal=6.0)).result()
    session.fly_both().result()
    wait_for(lambda: has_arrived(events))
    last: Any = events[-1].frame
    assert last.source is session.source
