"""What the curves draw: the points of lanes, their axes and their table."""

import csv
import dataclasses
import io

import numpy as np
import pytest
from small_source import small_config, small_source

from aero_planner import PlanStatus
from aero_viz.dashboard import curve_lanes
from aero_viz.dashboard.curve_lanes import Lane
from aero_viz.dashboard.history import COLUMNS, FlightHistory, Past
from aero_viz.dashboard.signals import PLANNING, read, signal
from aero_viz.planners.plan import CandidatePlan
from aero_viz.session import Session

GAP = 0.25


@pytest.fixture(scope="module")
def frame():
    session = Session(small_source(), config=small_config())
    yield session.tick()
    session.close()


def flown(times: np.ndarray, *, ghost: np.ndarray | None = None, **columns: np.ndarray) -> Past:
    """Return a flight with these columns; those of the ghost are the same numbers, at its times."""
    names = (*COLUMNS, *(name for name in columns if name not in COLUMNS))

    def rows(times: np.ndarray) -> np.ndarray:
        table = np.zeros((len(times), len(names)))
        table[:, 0] = times
        for name, values in columns.items():
            table[:, names.index(name)] = values[: len(times)]
        return table

    places = {name: place for place, name in enumerate(names)}
    other = rows(np.zeros(0) if ghost is None else ghost)
    return dataclasses.replace(FlightHistory().past(), columns=places, rows=rows(times), ghost=other)


def lane_of(*names: str) -> Lane:
    return Lane(signal(names[0]).axis, tuple(signal(name) for name in names))


@pytest.mark.parametrize("span", [None, (20.0, 30.0), (0.0, 1.0), (99.0, 200.0)])
def test_no_dip_of_ten_thousand_ticks_is_lost_and_few_are_sent(span):
    times = np.arange(10_000) * 0.02
    speed = np.ones(10_000)
    speed[1234], speed[7777] = -3.0, 9.0
    shown, values = curve_lanes.points(lane_of("speed"), flown(times, speed=speed), span, 500, gap=GAP)
    assert len(shown) < 4500 and shown[0] == 0.0 and shown[-1] == times[-1]
    assert set(values) == {1.0, -3.0, 9.0}
    np.testing.assert_array_equal(values, np.interp(shown, times, speed), "values are those of their ticks")


def test_what_is_looked_at_has_every_tick():
    times = np.arange(10_000) * 0.02
    shown, _ = curve_lanes.points(lane_of("speed"), flown(times, speed=times), (50.0, 55.0), 500, gap=GAP)
    inside = (times >= 50.0) & (times <= 55.0)
    assert set(times[inside]) <= set(shown)


def test_no_line_crosses_a_time_without_ticks():
    times = np.concatenate((np.arange(100), np.arange(500, 600))) * 0.02
    shown, values = curve_lanes.points(lane_of("speed"), flown(times, speed=times), None, 500, gap=GAP)
    assert np.isnan(values[(shown > 2.0) & (shown < 9.99)]).all() and np.isnan(values).sum() == 1


def test_the_ghost_has_its_own_ticks_and_none_beyond_its_end():
    times, ghost = np.arange(200) * 0.02, 0.01 + np.arange(50) * 0.02
    past = flown(times, ghost=ghost, speed=np.arange(200.0))
    shown, speed, before = curve_lanes.points(lane_of("speed"), past, None, 500, gap=GAP)
    np.testing.assert_allclose(before[np.isin(shown, ghost)], np.arange(50.0))
    assert np.isfinite(speed).all() and np.isnan(before[shown > ghost[-1]]).all()


def test_the_first_plan_which_compiles_does_not_flatten_the_curve_of_plan_times():
    times = np.arange(21) * 0.02
    past = flown(times, plan_ms=np.array([6391.0, *[10.0, 14.0] * 10]))
    lane = lane_of("plan_ms")
    data = curve_lanes.points(lane, past, None, 500, gap=GAP)
    low, high = curve_lanes.options(lane, data, None)["scales"]["y"]["range"]
    assert low == 0.0 and 14.0 <= high <= 20.0 and data[1][0] == 6391.0, "the value itself stays"
    only = curve_lanes.options(lane, (times[:1].astype(np.float64), np.array([6391.0])), None)["scales"]["y"]["range"]
    assert only[1] >= 6391.0


def test_lanes_are_those_of_the_axes_and_what_is_unknown_is_not_offered():
    past = flown(np.arange(5) * 0.02, cost=np.ones(5), goal_cost=np.ones(5), samples=np.full(5, np.nan))
    signals = curve_lanes.available(past)
    assert "samples" not in {one.name for one in signals}
    lanes = curve_lanes.chosen(signals, None)
    assert [lane.axis.title for lane in lanes][:3] == ["speed [m/s]", "clearance [m]", "cost of the choice"]
    assert [one.name for one in lanes[2].signals] == ["cost", "goal_cost"]
    assert [lane.axis.title for lane in curve_lanes.chosen(signals, ("x", "nothing"))] == ["position [m]"]


def test_the_table_has_both_flights_and_empty_cells_for_what_is_unknown():
    past = flown(np.arange(2) * 0.02, samples=np.array([1.0, np.nan]))
    assert curve_lanes.table(past, ["samples"]) == "time,samples\n0,1\n0.02,\n"
    both = dataclasses.replace(past, ghost=past.rows[:1], ghost_name="A")
    rows = list(csv.DictReader(io.StringIO(curve_lanes.table(both, ["speed"]))))
    assert [(row["flight"], row["time"]) for row in rows] == [("now", "0"), ("now", "0.02"), ("A", "0")]


def test_any_planner_has_its_costs_its_controls_and_its_own_numbers(frame):
    @dataclasses.dataclass(frozen=True, eq=False)
    class OwnPlan(CandidatePlan):
        courage: float = 0.0
        risk: np.ndarray | None = None

    paths = np.zeros((2, 4, 3)) + np.arange(4)[:, None] * 0.1
    own = OwnPlan(
        paths, {"smooth": np.array([1.0, 2.0]), "wind": np.array([3.0, 4.0])}, 1, 0.1, PlanStatus.OK,
        stage_ms={"search": 2.5}, courage=0.7, risk=np.array([0.1, 0.2]),
    )  # fmt: skip
    numbers = read(dataclasses.replace(frame, plan=own))
    assert (numbers["smooth_cost"], numbers["wind_cost"], numbers["cost"]) == (2.0, 4.0, 6.0)
    assert (numbers["courage"], numbers["risk"], numbers["search_ms"]) == (0.7, 0.2, 2.5)
    assert {"a_x", "a_y", "a_z", "yaw_rate"} <= numbers.keys() and signal("yaw_rate").axis.title == "control [rad/s]"
    assert signal("search_ms").axis == PLANNING and signal("courage").label == "courage"
    assert read(frame).keys() >= {"F_t", "omega_x", "samples", "goal_cost", "drag", "dropped_points"}
