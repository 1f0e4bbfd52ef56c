"""Figures, charts and legend of the status panel, without a browser."""

import dataclasses
import re
from collections.abc import Iterator

import numpy as np
import pytest
from small_source import small_config, small_source

from aero_planner import Plan, PlannerConfig, PlanStatus, Sweeps
from aero_viz.catalog import open_source
from aero_viz.dashboard import Dashboard
from aero_viz.dashboard.layers.drone import DroneLayer
from aero_viz.dashboard.panels import status
from aero_viz.dashboard.panels.compare import tick_table
from aero_viz.dashboard.panels.status import StatusPanel
from aero_viz.logs import flight_recorder
from aero_viz.session import Session


@pytest.fixture
def dashboard(session: Session) -> Iterator[Dashboard]:
    dashboard = Dashboard(session, port=0)
    yield dashboard
    dashboard.close()


def status_of(dashboard: Dashboard, **fields: object) -> str:
    """Return the panel's HTML for the session's frame, with some of its fields replaced."""
    (panel,) = (panel for panel in dashboard.panels if isinstance(panel, StatusPanel))
    frame = panel.session.frame
    assert frame is not None
    changes = panel.update(dataclasses.replace(frame, **fields))  # type: ignore[arg-type]
    return "".join(str(content) for _, _, content in changes)


def test_a_late_flight_is_reported_as_slow_and_drops_nothing(session, dashboard, monkeypatch):
    monkeypatch.setattr(status, "_SETTLE_TIME", 0.0)
    nominal = 1.0 / session.source.period
    assert "slower" not in status_of(dashboard, rate=nominal / 1.8), "nothing is late while time stands still"
    session.play()
    assert "1.8 times slower than real time" in status_of(dashboard, rate=nominal / 1.8)
    assert "slower" not in status_of(dashboard, rate=0.95 * nominal)
    session.set_speed(4.0)
    assert "2.0 times slower than requested" in status_of(dashboard, rate=2.0 * nominal)


def test_a_rate_from_before_a_change_of_speed_is_not_reported_as_slow(session, dashboard, monkeypatch):
    monkeypatch.setattr(status, "_SETTLE_TIME", 1e6)
    session.play()
    session.set_speed(4.0)
    assert "slower" not in status_of(dashboard, rate=1.0 / session.source.period)


def test_dropped_ticks_are_reported(dashboard):
    assert "dropped" not in status_of(dashboard)
    assert "12 ticks dropped" in status_of(dashboard, dropped_ticks=12)


@pytest.mark.parametrize(
    ("disturbance", "drag", "text"),
    [([0.3, 0.0, -0.4], 0.254, "0.25 1/s, 0.5 m/s²"), ([0.0, 0.0, 0.06], 0.0, "0.00 1/s, 0.1 m/s²")],
)
def test_estimated_drag_and_disturbance_are_shown(session, dashboard, disturbance: list[float], drag: float, text: str):
    estimates = {"disturbance": np.array(disturbance, np.float32), "drag": drag}
    assert text in status_of(dashboard, plan=dataclasses.replace(session.frame.plan, **estimates))


@pytest.mark.parametrize(("disturbance", "drag"), [(np.full(3, 0.02, np.float32), 0.005), (None, None)])
def test_estimates_that_are_small_or_unknown_are_not_shown(session, dashboard, disturbance, drag):
    plan = dataclasses.replace(session.frame.plan, disturbance=disturbance, drag=drag)
    assert "drag" not in status_of(dashboard, plan=plan)


def test_a_page_without_rollouts_has_a_status_without_the_chart_of_their_costs(session, dashboard):
    assert "shorter is better" in status_of(dashboard)
    small = Dashboard(session, port=0, layers=[DroneLayer])
    assert "filtered points" in status_of(small) and "shorter is better" not in status_of(small)
    small.close()


@pytest.mark.parametrize(("count", "text"), [(345, "/345<"), (9_999, "/9999<"), (172_345, "/172k<")])
def test_the_size_of_a_small_cloud_is_not_rounded_to_nothing(session, dashboard, count: int, text: str):
    seen = session.frame.observation
    sweeps = Sweeps([np.full((count, 3), 5.0, np.float32)])
    assert text in status_of(dashboard, observation=dataclasses.replace(seen, sweeps=sweeps))


def test_points_that_no_beam_has_hit_do_not_count_as_filtered_points(session, dashboard):
    plan = session.frame.plan
    continued = np.zeros(plan.fine_range.shape, np.bool_)
    continued[0, :7] = True
    count = len(plan.filtered_points) - 7
    assert f">{count}</span>" in status_of(dashboard, plan=dataclasses.replace(plan, continued_cells=continued))


def test_the_height_is_named_by_what_it_counts_from(session, dashboard):
    seen, source = session.frame.observation, session.frame.source
    above = dataclasses.replace(seen, ground_height=-1.5)
    assert re.search(r">height<.*?>3\.5<", status_of(dashboard, observation=above))
    unknown = dataclasses.replace(seen, ground_height=None)
    assert re.search(r">z<.*?>2\.0<", status_of(dashboard, observation=unknown))
    recording = dataclasses.replace(source, times=np.arange(3.0))
    shown = status_of(dashboard, observation=unknown, source=recording)
    assert re.search(r">z from first pose<.*?>2\.0<", shown) and ">height<" not in shown


def bars_of(content: str) -> list[str]:
    """Return the style of each bar."""
    return re.findall(r'title="\d+ \w+: S2[^"]*" style="([^"]*)"', content)


def faint_bars(content: str) -> list[int]:
    return [m for m, style in enumerate(bars_of(content)) if "opacity" in style]


def test_the_chosen_instance_is_no_rank_and_a_status_without_a_safe_candidate_is_named(session, dashboard):
    plan, best = session.frame.plan, int(session.frame.plan.best)
    content = status_of(dashboard)
    assert f"chosen: instance {best}, {plan.kinds[best]}</span>" in content
    assert "among safe candidates" in content and "no candidate is safe" not in content
    braking = dataclasses.replace(plan, status=PlanStatus.NO_SAFE_CANDIDATE)
    assert f"{plan.kinds[best]}; no candidate is safe</span>" in status_of(dashboard, plan=braking)
    config = session.frame.config.replace({"candidates.prefer_safe": False})
    assert "; the cheapest candidate is not safe</span>" in status_of(dashboard, plan=braking, config=config)


def test_bars_are_faint_for_the_instances_that_are_unsafe_and_the_table_counts_the_others(session, dashboard):
    is_safe = np.ones(len(session.frame.plan.kinds), np.bool_)
    is_safe[[2, 5]] = False
    assert faint_bars(status_of(dashboard, is_safe=is_safe)) == [2, 5]
    table = tick_table(session.frame, dataclasses.replace(session.frame, is_safe=is_safe))
    count = len(is_safe)
    assert re.search(f"safe candidates(<[^>]*>)+{count} of {count}(<[^>]*>)+{count - 2} of {count}<", table), table


def test_bars_are_faint_for_the_instances_that_the_plan_of_a_drone_shows_to_be_unsafe(session, dashboard):
    """Instances that cost less than the chosen one were not admissible, and without an admissible one none was."""
    plan, config = session.frame.plan, session.frame.config
    cost = np.arange(len(plan.kinds), dtype=np.float32)
    plan = dataclasses.replace(plan, stage2_cost=cost, best=2)

    def faint(plan: Plan, config: PlannerConfig = config) -> list[int]:
        return faint_bars(status_of(dashboard, plan=plan, config=config, is_safe=None))

    assert faint(plan) == [0, 1]
    cheapest_wins = config.replace({"candidates.prefer_safe": False})
    assert faint(plan, cheapest_wins) == []
    braking = dataclasses.replace(plan, status=PlanStatus.NO_SAFE_CANDIDATE)
    assert faint(braking) == list(range(len(plan.kinds)))
    assert faint(braking, cheapest_wins) == [2], "the one that is chosen"
    near = dataclasses.replace(plan, best=0, clearance=np.full_like(plan.clearance, 0.01))
    assert faint(near) == [], "the clearance does not say what the planner has found"


def test_the_first_tick_says_what_its_previous_plan_is(session, dashboard):
    plan, source = session.frame.plan, session.frame.source
    kinds = ("previous", *plan.kinds[1:])
    first = dataclasses.replace(plan, kinds=kinds, best=0)
    assert "previous; nothing was flown before" in status_of(dashboard, plan=first)
    assert "nothing was flown" not in status_of(dashboard, plan=first, index=1)
    recording = dataclasses.replace(source, times=np.arange(3.0))
    assert "nothing was flown" not in status_of(dashboard, plan=first, source=recording)


def test_a_log_names_the_live_planner_and_tells_its_end_once(tmp_path):
    path = tmp_path / "flight.mcap"
    flight = Session(small_source(goal=3.0), config=small_config())
    with flight_recorder(path) as log:
        while flight.frame is None or flight.frame.outcome is None:
            log.write(flight.tick())
    flight.close()
    source = open_source(str(path))
    session = Session(source, config=small_config())
    assert source.info.times is not None
    session.seek(source.info.times[-1]).result()
    session.tick()
    dashboard = Dashboard(session, port=0)
    content = status_of(dashboard)
    dashboard.close()
    session.close()
    assert session.frame is not None and session.frame.outcome == "end"
    assert content.count("It ended with: arrived.") == 1
    assert content.index("recorded plan: instance") < content.index("live planner on this cloud")
    assert content.index("live planner on this cloud") < content.index("filtered points")


def test_a_flight_has_one_plan_without_a_heading(dashboard):
    assert "live planner" not in status_of(dashboard)


LEGENDS = [
    ("rollouts", ["chosen rollout", "rank of the Stage II cost"]),
    ("samples", ["rank of the Stage I cost"]),
    ("guides", ["guides</span></div>"]),
    ("anchors", ["initial endpoints", "refined anchors"]),
    ("cloud", ["cloud: height"]),
    ("fine_cells", ["occupied, measured"]),
    ("unseen_cells", ["unseen, empty"]),
    ("occluded_space", ["occluded: no backup stop", "not seen: assumed free"]),
    ("coarse_cells", ["coarse cells", "safe directions"]),
    ("drone", ["drone"]),
    ("trail", ["flown trail"]),
    ("goal", ["goal</span></div>"]),
    ("obstacles", ["obstacles"]),
    ("ground", ["ground grid"]),
]
"""Layers and words of their legends."""


@pytest.mark.parametrize(("layer", "words"), LEGENDS)
def test_the_legend_has_a_key_for_every_layer_that_is_shown(session, dashboard, layer, words):
    def show(names: list[str]) -> str:
        dashboard.show_only(names)
        dashboard.changes(session.frame)
        return status_of(dashboard)

    assert not any(word in show([]) for word in words)
    assert all(word in show([layer]) for word in words)


def test_every_layer_has_a_legend_case(dashboard):
    without = {"recorded_path", "recorded_plan", "ghost", "alternative", "selection", "motion", "mission"}
    assert set(dashboard.layers) == {layer for layer, _ in LEGENDS} | without


def test_the_legend_names_the_quantity_that_colours_the_rollouts(dashboard):
    dashboard.layers["rollouts"].color_by.value = "log cost"
    content = status_of(dashboard)
    assert "log cost of" not in content and "rollouts: logarithm of the Stage II cost" in content
