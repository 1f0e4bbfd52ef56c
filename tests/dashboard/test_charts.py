"""Charts of a flight, without a browser."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from small_source import small_config, small_source

from aero_viz.dashboard import Dashboard
from aero_viz.dashboard.layers import apply
from aero_viz.dashboard.panels import charts
from aero_viz.dashboard.panels.charts import ChartPanel
from aero_viz.session import Session


class Curves:
    """A flight, and the curves that the page shows of it."""

    def __init__(self, session: Session, panel: ChartPanel) -> None:
        self.session, self._panel = session, panel

    def look(self) -> tuple[np.ndarray, float]:
        """Times of the curve's rows, and the time of the mark, a spike in the same rows [s]."""
        frame = self.session.frame
        assert frame is not None
        apply(self._panel.update(frame))
        time, *_, mark = self._panel.motion.data
        (present,) = np.flatnonzero(mark)
        assert time[present - 1] == time[present] == time[present + 1]
        return np.unique(time), float(time[present])

    def restart(self) -> None:
        """Show the session's source as if it were another one."""
        apply(self._panel.on_new_source(self.session.source))

    def labels(self) -> list[str]:
        return [str(series.get("label")) for series in self._panel.motion.series]


@pytest.fixture
def curves() -> Iterator[Curves]:
    session = Session(small_source(), config=small_config())
    dashboard = Dashboard(session, port=0)
    (panel,) = (panel for panel in dashboard.panels if isinstance(panel, ChartPanel))
    yield Curves(session, panel)
    dashboard.close()
    session.close()


def fly(curves: Curves, ticks: int) -> np.ndarray:
    times = np.zeros(0)
    for _ in range(ticks):
        curves.session.tick()
        times, _ = curves.look()
    return times


def test_going_back_keeps_the_curve_until_the_flight_continues_from_there(curves):
    flown = fly(curves, 20)
    curves.session.step(-10)
    times, now = curves.look()
    np.testing.assert_array_equal(times, flown)
    assert now == flown[9]
    curves.session.seek(float(flown[4])).result()
    times, now = curves.look()
    np.testing.assert_array_equal(times, flown)
    assert now == flown[4]
    curves.session.configure({"costs.q_track": 3.0})  # plans this tick again, without flying on
    times, now = curves.look()
    np.testing.assert_array_equal(times, flown)
    assert now == flown[4]
    curves.session.step(1)
    times, now = curves.look()
    np.testing.assert_array_equal(times, flown[:6])
    assert now == flown[5]


def test_a_long_flight_is_drawn_whole_with_few_rows(curves, monkeypatch):
    monkeypatch.setattr(charts, "_ROWS", 8)
    times = fly(curves, 40)
    assert len(times) == 8 and times[0] == 0.0 and times[-1] == curves.session.frame.time
    assert np.diff(times).max() < 0.4 * times[-1]


def test_another_source_starts_a_new_curve(curves):
    fly(curves, 5)
    curves.restart()
    curves.session.seek(0.0).result()
    times, now = curves.look()
    assert now == times[0] == 0.0 and len(times) == 2, "the axis needs a length, or the page keeps the previous one"


def test_the_chart_labels_the_largest_clearance_that_is_measured(curves):
    fly(curves, 2)
    assert "≥ 0.55 m" in curves.labels()
    curves.session.configure({"costs.distance_max": 0.8})
    curves.look()
    assert "≥ 0.80 m" in curves.labels()
