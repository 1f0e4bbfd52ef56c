"""Rate of page updates, without a clock."""

import pytest

from aero_viz.dashboard.update_rate import MAX_RATE, MIN_RATE, UpdateRateLimiter


def rates(limiter: UpdateRateLimiter, tick_rate: float, count: int) -> list[float]:
    """Return the update rate [Hz] after each of `count` updates, with an engine that should tick at 50 Hz."""
    seen = []
    for _ in range(count):
        limiter.adapt(tick_rate, 50.0)
        seen.append(1.0 / limiter.period)
    return seen


def test_an_engine_on_time_is_shown_at_the_highest_rate():
    assert rates(UpdateRateLimiter(), 50.0, 10) == [pytest.approx(MAX_RATE)] * 10


def test_a_late_engine_is_shown_less_often_but_never_below_the_lowest_rate():
    limiter = UpdateRateLimiter()
    seen = rates(limiter, 40.0, 100)
    assert seen[0] < MAX_RATE and seen[-1] == pytest.approx(MIN_RATE)
    assert min(seen) >= MIN_RATE - 1e-9
    assert seen == sorted(seen, reverse=True)


def test_the_rate_returns_slowly_when_the_engine_has_caught_up():
    limiter = UpdateRateLimiter()
    rates(limiter, 40.0, 100)
    seen = rates(limiter, 50.0, 100)
    assert seen[0] < MIN_RATE * 1.05 and seen[-1] == pytest.approx(MAX_RATE)
    assert seen == sorted(seen)


def test_up_to_three_missing_ticks_per_second_count_as_on_time():
    assert rates(UpdateRateLimiter(), 47.0, 1) == [pytest.approx(MAX_RATE)]


@pytest.fixture
def on_time() -> UpdateRateLimiter:
    """A limiter with an update that ended when it was due, at 100 s."""
    limiter = UpdateRateLimiter()
    assert [limiter.delay(100.0) for _ in range(2)] == [0.0, 0.0], "nothing is due before the first update"
    return limiter


def test_a_late_update_does_not_delay_those_after_it(on_time: UpdateRateLimiter):
    period = 1.0 / MAX_RATE
    assert on_time.delay(100.0 + 0.2 * period) == pytest.approx(0.8 * period)
    assert on_time.delay(100.0 + 1.5 * period) == pytest.approx(0.5 * period), "half a period late, then on time again"
    assert on_time.delay(100.0 + 3.7 * period) == 0.0, "0.7 periods late"
    assert on_time.delay(100.0 + 3.8 * period) == pytest.approx(0.2 * period)


def test_of_a_long_pause_one_update_is_made_up_for(on_time: UpdateRateLimiter):
    now, period = 109.0, 1.0 / MAX_RATE
    assert [on_time.delay(now) for _ in range(3)] == pytest.approx([0.0, 0.0, period])
