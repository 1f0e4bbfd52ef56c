import threading

import pytest

from aero_planner.onboard.periodic_loop import DeadlineStatistics, PeriodicLoop


class Clock(threading.Event):
    """A clock that advances only during `wait`, and the event that ends the loop."""

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
    ("on_grid", "times"), [(True, [0.0, 0.01, 0.02, 0.03, 0.07, 0.08]), (False, [0.0, 0.01, 0.02, 0.03, 0.065, 0.075])]
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
    # The duration of a call does not shift later ones. After a call of 35 ms, three deadlines are skipped on the grid.
    assert begun == times
    summary = loop.statistics.summary()
    assert (summary["ticks"], summary["missed"], summary["period_ms"]) == (6, 3, 10.0)
    assert summary["late_max_ms"] == pytest.approx(0.0, abs=1e-6)


def test_statistics_report_lateness_and_jitter():
    statistics = DeadlineStatistics(0.02)
    assert statistics.summary()["late_median_ms"] is None and statistics.summary()["jitter_ms"] is None
    for k, late in enumerate((0.0, 0.001, 0.002, 0.003, 0.004)):
        statistics.add_tick(0.02 * k, 0.02 * k + late)
    summary = statistics.summary()
    assert summary["late_median_ms"] == pytest.approx(2.0) and summary["late_max_ms"] == pytest.approx(4.0)
    assert summary["jitter_ms"] == pytest.approx(0.0, abs=1e-9)  # all are 21 ms apart
