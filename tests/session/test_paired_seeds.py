"""Flights of two configurations through the worlds of the same seeds."""

import dataclasses

from small_source import small_config, small_source

from aero_viz.session import Session
from aero_viz.session.paired_seeds import fly_seeds
from aero_viz.statistics import SeedFlight

FAST = small_config()
SLOW = FAST.replace({"vehicle.speed_limit": 2.0})


def test_both_fly_the_same_seeds_and_are_compared_in_pairs():
    flown = list(
        fly_seeds(
            lambda _: small_source(goal=3.0), [3, 4], lambda _: FAST, lambda _: SLOW, device="cpu", goes_on=lambda: True
        )
    )
    assert [list(part.seeds) for part in flown] == [[3], [3, 4]]
    last = flown[-1]
    assert all(one.arrived for one in (*last.a, *last.b)) and last.comparison.faster_a == 2
    assert last.comparison.slower_by_s is not None and last.comparison.slower_by_s[0] > 0.0
    (low, high), same = last.intervals
    assert (low, high) == same and 0.2 < low < 0.5 < high == 1.0, "Wilson's interval of two of two"
    session = Session(small_source(goal=3.0), config=SLOW, seed=4)
    while (frame := session.tick()).outcome is None:
        pass
    session.close()
    assert last.b[1] == SeedFlight(frame.outcome, frame.time)
    failed = dataclasses.replace(last, b=[SeedFlight("collision", 1.0)] * 2)
    assert failed.comparison.only_a == 2 and failed.comparison.arrived_b == 0


def test_a_pair_that_was_stopped_does_not_count():
    ticks = iter(range(40))
    flown = fly_seeds(
        lambda _: small_source(), [0], lambda _: FAST, lambda _: SLOW, device="cpu",
        goes_on=lambda: next(ticks, None) is not None,
    )  # fmt: skip
    assert list(flown) == []
