"""The drawing of the curves: headings, axes, and colours of events, without a browser."""

import dataclasses
import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from aero_viz.cost_text import cost_text
from aero_viz.dashboard import Dashboard, palette
from aero_viz.dashboard.history import COLUMNS
from aero_viz.dashboard.palette import css
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.charts import CURVES, ChartPanel, table
from aero_viz.dashboard.panels.status import StatusPanel
from aero_viz.logs import flight_recorder
from aero_viz.session import Session
from aero_viz.session.frame import Frame
from tests.dashboard.page_client import wait_for


@pytest.fixture
def dashboard(session: Session) -> Iterator[Dashboard]:
    dashboard = Dashboard(session, port=0)
    # The frame arrives in the background, and would replace one that a test adds for the same tick.
    wait_for(lambda: len(dashboard.history.past().rows), "the session's frame in the history")
    yield dashboard
    dashboard.close()


def later(frame: Frame, ticks: int, **changes: Any) -> Frame:
    """Return a frame of a later tick, which the session has not reached, with changed fields."""
    return dataclasses.replace(frame, index=frame.index + ticks, time=frame.time + 0.02 * ticks, **changes)


def content_of(dashboard: Dashboard, kind: type, frame: Frame) -> str:
    """Return the HTML of a panel for a frame."""
    (panel,) = (panel for panel in dashboard.panels if isinstance(panel, kind))
    return "".join(str(content) for _, _, content in panel.update(frame))


@pytest.mark.parametrize(
    ("outcome", "color"),
    [
        ("arrived", palette.GOOD),
        ("collision", palette.BAD),
        ("end", palette.MUTED),
        ("stall", palette.WARNING),
        ("timeout", palette.WARNING),
    ],
)
def test_an_outcome_has_the_same_colour_in_the_curves_and_in_the_status(session, dashboard, outcome, color):
    ended = later(session.frame, 1, outcome=outcome)
    dashboard.history.add(ended)
    drawing = content_of(dashboard, ChartPanel, ended)
    assert re.findall(r'class="aero-event"[^>]* fill="([^"]*)"', drawing) == [css(color)]
    assert f'<span style="color:{markup.ink(color)}">{ended.time:.2f} s</span> {outcome}' in drawing
    assert markup.pill(outcome, color) in content_of(dashboard, StatusPanel, ended)


def axis(drawing: str, name: str) -> float:
    """Return the upper end of the axis of a curve."""
    (top,) = re.findall(rf'data-curve="{name}".*?>([^<>]*)</text>', drawing)
    return float(top)


def test_the_first_plan_which_compiles_does_not_flatten_the_curve_of_plan_times(session, dashboard):
    for ticks, plan_ms in enumerate([6391.0, *[10.0, 14.0] * 10]):
        dashboard.history.add(later(session.frame, ticks, timings_ms={"plan": plan_ms}))
    drawing = content_of(dashboard, ChartPanel, session.frame)
    assert 14.0 <= axis(drawing, "plan_ms") < 20.0
    assert dashboard.history.past().rows[0, COLUMNS.index("plan_ms")] == 6391.0, "the value itself stays"


def test_a_curve_of_zeros_has_an_axis_that_can_be_read(session, dashboard):
    plan = session.frame.plan
    near = dataclasses.replace(plan, clearance=np.zeros_like(plan.clearance))
    is_safe = np.zeros(len(plan.kinds), np.bool_)
    dashboard.history.add(dataclasses.replace(session.frame, plan=near, is_safe=is_safe))
    assert axis(content_of(dashboard, ChartPanel, session.frame), "safe") == 1.0


def test_only_a_world_has_a_true_clearance(session, dashboard):
    assert "true clearance [m]" in content_of(dashboard, ChartPanel, session.frame)
    source = dataclasses.replace(session.frame.source, world=None)
    observation = dataclasses.replace(session.frame.observation, world=None)
    recorded = dataclasses.replace(session.frame, source=source, observation=observation)
    content = content_of(dashboard, ChartPanel, recorded)
    assert "clearance to the cloud [m]" in content and "true clearance" not in content


def test_one_plan_has_a_curve(session, dashboard):
    dashboard.history.add(dataclasses.replace(session.frame, timings_ms={"plan": 6391.0}))
    assert axis(content_of(dashboard, ChartPanel, session.frame), "plan_ms") == 6391.0


def test_each_cost_is_named_in_the_colour_of_its_curve(session, dashboard):
    drawing, plan = content_of(dashboard, ChartPanel, session.frame), session.frame.plan
    (curve,) = (curve for curve in CURVES if curve.is_log)
    assert curve.label.endswith("(log)") and curve.label in drawing
    costs = zip(curve.colors, ("all", "goal", "collision"), curve.columns, strict=True)
    for color, name, column in costs:
        value = (plan.stage2_cost if column == "cost" else getattr(plan, column))[plan.best]
        assert f'<span style="color:{markup.ink(color)}">{name} {cost_text(value)}</span>' in drawing


def test_a_curve_of_which_a_log_holds_nothing_is_left_out(session, dashboard, tmp_path):
    from aero_viz.dashboard.logged_history import LoggedHistory
    from aero_viz.logs.comparison import compare_logs

    path = tmp_path / "flight.mcap"
    with flight_recorder(path) as log:
        for _ in range(5):
            log.write(session.tick())
    history = LoggedHistory(compare_logs(path, path), start=0.0)
    assert np.isnan(history.past().rows[:, COLUMNS.index("samples")]).all()
    compared = Dashboard(session, port=0, history=history)
    drawing = content_of(compared, ChartPanel, session.frame)
    compared.close()
    assert "effective samples" not in drawing and 'data-curve="speed"' in drawing


def test_a_figure_that_is_not_known_is_an_empty_cell():
    rows = np.ones((2, len(COLUMNS)))
    rows[1, COLUMNS.index("samples")] = np.nan
    (curve,) = (curve for curve in CURVES if curve.columns == ("samples",))
    assert table(rows, [curve]) == "time,samples\n1,1\n1,\n"
