"""Time stamps of a device in host time."""

import numpy as np
import pytest

from aero_planner.onboard.host_clock import HostClock

OFFSET = 5000.0


def feed(clock, stamps, delays):
    """Map messages with these stamps and delays; return their true and their mapped host times."""
    mapped = [clock.to_host(stamp, stamp + OFFSET + delay) for stamp, delay in zip(stamps, delays, strict=True)]
    return stamps + OFFSET, np.array([np.nan if value is None else value for value in mapped])


def test_the_offset_comes_from_the_smallest_delay():
    random = np.random.default_rng(0)
    delays = 0.002 + random.exponential(0.01, size=1000)
    true, mapped = feed(HostClock(), np.arange(1000) * 0.01, delays)
    assert np.abs(mapped[100:] - true[100:] - 0.002).max() < 1e-3
    assert (mapped <= true + delays + 1e-9).all()


def test_the_age_of_a_late_message_is_right():
    clock = HostClock()
    feed(clock, np.arange(100) * 0.01, np.full(100, 0.001))
    assert clock.to_host(1.0, 1.0 + OFFSET + 0.8) == pytest.approx(1.001 + OFFSET)


@pytest.mark.parametrize("drift", [-100e-6, 100e-6])
def test_it_follows_a_drift(drift):
    clock = HostClock()
    times = np.arange(0.0, 600.0, 0.05)
    stamps = times * (1.0 + drift)
    mapped = np.array([clock.to_host(stamp, time + 0.001) for stamp, time in zip(stamps, times, strict=True)])
    # 100 ppm over the 10 s for which a minimum is used.
    assert np.abs(mapped - times - 0.001).max() < 1.1e-3


def test_a_clock_that_was_set_is_believed_after_twenty_messages():
    clock = HostClock()
    feed(clock, np.arange(100) * 0.01, np.full(100, 0.001))
    answers = [clock.to_host(0.01 * k, OFFSET + 1.0 + 0.01 * k) for k in range(-500, -460)]
    assert answers[: HostClock.PATIENCE - 1] == [None] * (HostClock.PATIENCE - 1)
    assert answers[-1] == pytest.approx(OFFSET + 1.0 - 0.01 * 461)
    assert clock.rejected == HostClock.PATIENCE - 1


def test_single_wild_stamps_change_nothing():
    clock = HostClock()
    feed(clock, np.arange(100) * 0.01, np.full(100, 0.001))
    for wild in (1e12, -1e12, 3.0, -3.0, np.nan, np.inf):
        assert clock.to_host(wild, OFFSET + 1.0) is None
    assert clock.to_host(1.0, OFFSET + 1.002) == pytest.approx(OFFSET + 1.001)


def test_after_a_long_silence_the_offset_is_estimated_anew():
    clock = HostClock()
    feed(clock, np.arange(10) * 0.01, np.full(10, 0.001))
    assert clock.to_host(100.0, OFFSET + 100.0 + 0.3) == pytest.approx(OFFSET + 100.3)
