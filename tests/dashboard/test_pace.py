"""How the rate of updates gives way to planning, without a clock."""

from __future__ import annotations

import pytest

from aero_viz.dashboard.pace import FASTEST, SLOWEST, Pace


def rates(pace: Pace, made: float, count: int) -> list[float]:
    """Updates per second after each of `count` updates while the engine makes so many of its 50 ticks per second."""
    seen = []
    for _ in range(count):
        pace.note(made, 50.0)
        seen.append(1.0 / pace.period)
    return seen


def test_an_engine_on_time_is_shown_as_often_as_can_be():
    assert rates(Pace(), 50.0, 10) == [pytest.approx(FASTEST)] * 10


def test_a_late_engine_is_shown_less_often_but_never_below_the_least():
    pace = Pace()
    seen = rates(pace, 40.0, 100)
    assert seen[0] < FASTEST and seen[-1] == pytest.approx(SLOWEST)
    assert min(seen) >= SLOWEST - 1e-9
    assert seen == sorted(seen, reverse=True)


def test_the_rate_returns_slowly_when_the_engine_has_caught_up():
    pace = Pace()
    rates(pace, 40.0, 100)
    seen = rates(pace, 50.0, 100)
    assert seen[0] < SLOWEST * 1.05 and seen[-1] == pytest.approx(FASTEST)
    assert seen == sorted(seen)


def test_a_tick_or_two_per_second_fewer_is_on_time():
    assert rates(Pace(), 49.0, 1) == [pytest.approx(FASTEST)]


def test_a_late_update_does_not_delay_those_after_it():
    pace = Pace()
    period = 1.0 / FASTEST
    assert pace.delay(100.0) == 0.0, "nothing is due before the first"
    assert pace.delay(100.0 + 0.2 * period) == pytest.approx(0.8 * period)
    assert pace.delay(100.0 + 1.5 * period) == pytest.approx(0.5 * period), "half a period late, caught up with"
    assert pace.delay(100.0 + 9.0 * period) == 0.0, "a long pause is no debt"
    assert pace.delay(100.0 + 9.1 * period) == pytest.approx(0.9 * period)
