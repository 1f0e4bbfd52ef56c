from __future__ import annotations

import threading

import pytest

from aero_planner.mailbox import Mailbox
from aero_planner.onboard.periodic_loop import DeadlineStatistics, PeriodicLoop


class Clock(threading.Event):
    """Time that passes only while somebody waits, and the event that ends the loop."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 50.0

    def __call__(self) -> float:
        return self.now

    def wait(self, timeout: float | None = None) -> bool:
        assert timeout is not None
        self.now += timeout
        return self.is_set()


@pytest.mark.parametrize(
    ("on_grid", "times"),
    [(True, [0.0, 0.01, 0.02, 0.03, 0.07, 0.08]), (False, [0.0, 0.01, 0.02, 0.03, 0.065, 0.075])],
)
def test_deadlines_are_absolute_and_late_calls_skip(on_grid: bool, times: list[float]):
    clock, begun = Clock(), []
    took = iter([0.001, 0.005, 0.0, 0.035, 0.001, 0.0])

    def call() -> None:
        begun.append(round(clock.now - 50.0, 6))
        clock.now += next(took)
        if len(begun) == 6:
            clock.set()

    loop = PeriodicLoop(0.01, call, clock=clock, stopped=clock, on_grid=on_grid)
    loop.run()
    # What a call takes does not shift those after it; after one of 35 ms three deadlines are left out, or caught up.
    assert begun == times
    summary = loop.statistics.summary()
    assert (summary["ticks"], summary["missed"], summary["period_ms"]) == (6, 3, 10.0)
    assert summary["late_max_ms"] == pytest.approx(0.0, abs=1e-6)


def test_statistics_tell_lateness_and_jitter():
    statistics = DeadlineStatistics(0.02)
    assert statistics.summary()["late_median_ms"] is None and statistics.summary()["jitter_ms"] is None
    for k, late in enumerate((0.0, 0.001, 0.002, 0.003, 0.004)):
        statistics.add_tick(0.02 * k, 0.02 * k + late)
    summary = statistics.summary()
    assert summary["late_median_ms"] == pytest.approx(2.0) and summary["late_max_ms"] == pytest.approx(4.0)
    assert summary["jitter_ms"] == pytest.approx(0.0, abs=1e-9)  # each comes 21 ms after the one before


def test_a_mailbox_keeps_the_newest_and_delays_nobody():
    gate, first, seen = threading.Event(), threading.Event(), []

    def slow(item: int) -> None:
        first.set()
        assert gate.wait(10.0)
        seen.append(item)

    box: Mailbox[int] = Mailbox(slow, capacity=3, name="test")
    box.put(0)
    assert first.wait(10.0)
    for i in range(1, 100):
        box.put(i)  # returns although the callback hangs
    gate.set()
    box.finish()
    assert seen == [0, 97, 98, 99] and box.dropped == 96


def test_a_mailbox_survives_its_callback():
    seen = []

    def bad(item: int) -> None:
        seen.append(item)
        raise RuntimeError("no")

    box: Mailbox[int] = Mailbox(bad, capacity=10, name="test")
    for i in range(5):
        box.put(i)
    box.finish()
    assert seen == [0, 1, 2, 3, 4] and box.failures == 5
