"""`aero-viz compare`: figures, parameters and conditions of two logs."""

import dataclasses
import json
from pathlib import Path

import pytest
from command_line import run, run_json, run_refused
from ensemble_plans import plan_of
from small_source import small_config, small_source

from aero_planner import PlanStatus
from aero_viz.dashboard.history import COLUMNS
from aero_viz.dashboard.logged_history import LoggedHistory
from aero_viz.logs import flight_recorder
from aero_viz.logs.comparison import compare_logs
from aero_viz.session import Session


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Logs of two flights through the same world, the second one slower, and their last frames."""
    folder, paths, ends = tmp_path_factory.mktemp("logs"), [], []
    for name, speed in (("fast", 7.0), ("slow", 3.0)):
        path = folder / f"{name}.mcap"
        config = small_config().replace({"vehicle.speed_limit": speed})
        session = Session(small_source(goal=8.0), config=config)
        with flight_recorder(path) as log:
            while session.frame is None or session.frame.outcome is None:
                log.write(session.tick())
        ends.append(session.frame)
        session.close()
        paths.append(str(path))
    return paths, ends


def test_the_report_has_figures_and_only_what_differs(logs, capsys):
    (fast, slow), (a, b) = logs
    report = run_json(capsys, "compare", fast, slow)
    assert (report["a"]["file"], report["b"]["outcome"]) == ("fast.mcap", b.outcome)
    assert report["a"]["time_s"] == pytest.approx(a.time, abs=1e-6)
    assert report["b"]["time_s"] == pytest.approx(b.time, abs=1e-6)
    assert report["a"]["mean_speed"] > report["b"]["mean_speed"]
    assert report["a"]["mean_speed"] == pytest.approx(report["a"]["length_m"] / report["a"]["time_s"])
    assert 0.0 < report["differs_at_s"] < 1.0
    assert report["parameters"] == {"vehicle.speed_limit": {"a": 7.0, "b": 3.0}}
    assert report["conditions"] == {}
    code, text, _ = run(capsys, "compare", fast, slow)
    assert code == 0
    assert "vehicle.speed_limit" in text and "No condition differs." in text and "The paths differ from" in text


def test_a_log_does_not_differ_from_itself(logs, capsys):
    report = run_json(capsys, "compare", logs[0][0], logs[0][0])
    assert report["differs_at_s"] is None and report["parameters"] == {}
    a, b = ({name: value for name, value in report[key].items()} for key in "ab")
    assert a == b


def test_the_figures_are_those_of_the_flight(logs):
    (fast, slow), (a, _) = logs
    columns = compare_logs(fast, slow).a.columns
    best = int(a.plan.best)
    assert columns["cost"][-1] == pytest.approx(float(a.plan.stage2_cost[best]), rel=1e-5)
    assert columns["speed"][-1] == pytest.approx(float((a.observation.actual_state.velocity**2).sum() ** 0.5), abs=1e-3)
    exact = float(a.source.world.distance(a.observation.actual_state.position[None])[0])
    assert columns["clearance"][-1] == pytest.approx(min(exact, 5.0), abs=1e-4)


def test_clearance_is_from_moving_obstacles_where_they_are_at_the_time(tmp_path, capsys):
    """A pillar on the way of the drone has left it when the drone comes by."""
    world = {"name": "gate", "start": [0, 0, 2], "goal": [20, 0, 2], "cylinders": [[2, 0, 0, 0, 0, 1, 0.2, 5]]}
    (tmp_path / "world.json").write_text(json.dumps({**world, "motion": [[0.0, 8.0, 40.0]]}))
    log = str(tmp_path / "flight.mcap")
    arguments = [str(tmp_path / "world.json"), "--sampling.samples", "16", "--lidar.points-per-sweep", "1000"]
    flown = run_json(capsys, "fly", *arguments, "--rules.time-limit", "1.5", "--log", log)
    figures = run_json(capsys, "compare", log, log)["a"]
    assert flown["min_clearance"] > 0.5 and figures["length_m"] > 2.0
    assert figures["min_clearance"] == pytest.approx(flown["min_clearance"], abs=0.02)


def test_ticks_without_a_safe_candidate_are_those_of_the_planner(tmp_path, capsys):
    path = tmp_path / "flight.mcap"
    session = Session(small_source(), config=small_config())
    with flight_recorder(path) as log:
        for tick in range(6):
            frame = session.tick()
            assert (frame.plan.clearance.min(axis=1) >= frame.config.candidates.safe_clearance).any()
            status = PlanStatus.NO_SAFE_CANDIDATE if tick in (2, 3) else frame.plan.status
            log.write(dataclasses.replace(frame, plan=dataclasses.replace(plan_of(frame), status=status)))
    session.close()
    assert run_json(capsys, "compare", str(path), str(path))["a"]["unsafe_ticks"] == 2


def test_the_page_shows_both_logs_in_one_time_base(logs):
    (fast, slow), (a, b) = logs
    past = LoggedHistory(compare_logs(fast, slow), start=0.25).past()
    assert past.rows.shape[1] == past.ghost.shape[1] == len(past.columns)
    assert {*COLUMNS, "cost", "goal_cost", "clear"} <= past.columns.keys()
    assert past.rows[-1, 0] == pytest.approx(b.time + 0.25) and past.ghost[-1, 0] == pytest.approx(a.time + 0.25)
    assert (past.ghost_name, past.outcome, past.ghost_outcome) == ("fast.mcap", b.outcome, a.outcome)
    assert past.differs_at is not None and past.differs_at > 0.25


def test_what_is_no_flight_log_is_named(logs, tmp_path, capsys):
    assert "nowhere.mcap" in run_refused(capsys, "compare", logs[0][0], "nowhere.mcap")
    (tmp_path / "text.mcap").write_text("no log")
    assert "is not a flight log" in run_refused(capsys, "compare", str(tmp_path / "text.mcap"), logs[0][0])
    content = Path(logs[0][0]).read_bytes()
    damaged = bytearray(content)
    damaged[len(content) // 3 : len(content) // 3 + 2000] = bytes(2000)
    (tmp_path / "damaged.mcap").write_bytes(damaged)
    assert "damaged.mcap" in run_refused(capsys, "compare", str(tmp_path / "damaged.mcap"), logs[0][0])


def test_a_log_that_was_cut_off_is_compared_up_to_the_cut(logs, tmp_path, capsys):
    content = Path(logs[0][0]).read_bytes()
    (tmp_path / "cut.mcap").write_bytes(content[: len(content) // 2])
    code, text, _ = run(capsys, "compare", str(tmp_path / "cut.mcap"), logs[0][0])
    assert code == 0 and "cut short" in text
