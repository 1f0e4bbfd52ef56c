"""A planner of the test's own in the whole workbench: session, log, replay, post-mortem, benchmark, study and page."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import run_json, run_refused
from small_source import small_config, small_source
from straight import StraightConfig

from aero_viz.catalog import open_source
from aero_viz.dashboard import Dashboard
from aero_viz.evaluation.bench import Benchmark, Row, run_benchmark
from aero_viz.evaluation.bench.side_by_side import compare_side_by_side
from aero_viz.evaluation.tune import FlightOptions, SearchOptions, parse_ranges, tune
from aero_viz.explain.evidence import Evidence, Replanner
from aero_viz.explain.post_mortem import explain_flight
from aero_viz.explain.trace import FlightTrace, trace_of_log
from aero_viz.flight import FlightRules, fly
from aero_viz.flight.serial import SerialFlights
from aero_viz.logs import flight_recorder
from aero_viz.logs.comparison import compare_logs
from aero_viz.logs.log_contents import read_log
from aero_viz.planners import load
from aero_viz.scenes import World
from aero_viz.sensors import LidarModel
from aero_viz.session import Session

LIDAR = LidarModel("sparse", points_per_sweep=500)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Log of a flight that hits a pole."""
    path = tmp_path_factory.mktemp("log") / "straight.mcap"
    with small_session() as session, flight_recorder(path) as recorder:
        frame = session.tick()
        while frame.outcome is None:
            recorder.write(frame)
            frame = session.tick()
        recorder.write(frame)
    return path


class small_session:
    """A session of the straight planner, which is closed at the end of the context."""

    def __init__(self, **options: Any) -> None:
        self.session = Session(small_source(), config=StraightConfig(), **options)

    def __enter__(self) -> Session:
        return self.session

    def __exit__(self, *_: object) -> None:
        self.session.close()


def test_a_session_repeats_a_tick_and_undoes_a_change():
    with small_session() as session:
        frames = [session.tick() for _ in range(6)]
        assert frames[5].plan.costs["count"][1] == pytest.approx(6e-3), "it has planned six times"
        session.seek(frames[2].time).result()
        assert session.frame is not None and session.frame.plan.costs["count"][1] == pytest.approx(3e-3)
        assert session.configure({"line.gain": 0.5}).preset_name == "soft"
        session.undo()
        assert session.config == StraightConfig()
        with pytest.raises(ValueError, match=r"unknown parameter 'line.gian'.*did you mean 'line.gain'"):
            session.configure({"line.gian": 1.0})


def test_a_and_b_are_compared_also_if_a_is_for_another_planner():
    with small_session() as session:
        for _ in range(3):
            session.tick()
        session.pin().result()
        session.configure({"line.gain": 0.5})
        session.comparison.work()
        a = session.comparison.frame
        assert a is not None and session.frame is not None and a.config == StraightConfig()
        assert not np.array_equal(a.plan.command, session.frame.plan.command)
        assert "total" not in a.plan.stage_ms and a.timings_ms["plan"] > 0.0 < session.frame.timings_ms["plan"]
        session.comparison.pin(small_config())
        session.comparison.work()
        assert session.comparison.frame is not None and "anchors" in session.comparison.frame.plan.extensions


def test_a_log_holds_the_planner_its_costs_by_term_and_its_paths(log: Path):
    contents = read_log(log)
    assert contents.config() == StraightConfig() and contents.outcome == "collision" and not contents.damaged
    plan = contents.plans[-1]
    assert list(plan.costs) == ["goal", "count"] and plan.kinds == ("line", "hover") and plan.path.shape == (11, 3)
    np.testing.assert_allclose(sum(plan.costs.values()), plan.stage2_cost, rtol=1e-5)
    comparison = compare_logs(log, log)
    assert comparison.differs_at is None and "No parameter differs." in comparison.format_table()
    assert comparison.a.conditions["planner"] == "straight:Straight"


def test_a_log_is_replayed_with_its_plans_by_any_planner(log: Path):
    source = open_source(str(log))
    recorded = source.info.recorded_plan
    assert recorded is not None and (plan := recorded(0.2)) is not None and plan.kinds == ("line", "hover")
    session = Session(source, config=load("primitives").Config())
    assert session.tick().plan.kinds[-1] == "brake"
    session.close()


def test_a_post_mortem_tells_what_any_planner_tells(log: Path):
    report, evidence = explain_flight(trace_of_log(log))
    assert report.outcome == "collision" and report.obstacle == "cylinder 1" and evidence is not None
    text = report.format_table()
    assert "Whether braking would have worked is not known: this planner reports no braking paths." in text
    assert evidence.is_safe.tolist() == [True, False] and not isinstance(evidence, Evidence)
    trace = FlightTrace()
    with small_session() as session:
        for _ in range(4):
            trace.write(session.tick())
    trace.outcome = "timeout"
    report, _ = explain_flight(trace)
    assert report.cause is not None and report.cause.startswith("out of time")
    assert "It chose candidate 0 (line), at a cost of" in report.format_table()


def test_the_costs_of_a_plan_are_explained_from_a_plan_that_is_made_again():
    replan = Replanner()
    with small_session() as session:
        frame = [session.tick() for _ in range(3)][-1]
        evidence = replan(frame)
        assert evidence.is_exact and evidence.plan is not frame.plan
    replan.close()


def test_a_benchmark_flies_one_after_another_and_three_planners_stand_side_by_side(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    row = Row("few trees", "forest", 2, speed=3.0)
    benchmark = Benchmark("small", "A small benchmark", "For tests.", (row,))
    options: dict[str, Any] = {
        "flights": 2, "rules": FlightRules(time_limit=0.3), "sensor": {"points_per_sweep": 500}, "examine": False,
        "causes": False,
    }  # fmt: skip
    configs = [small_config(), StraightConfig(), load("primitives").Config()]
    folders = [str(tmp_path / name) for name in ("aero", "straight", "primitives")]
    for config, folder in zip(configs, folders, strict=True):
        run = run_benchmark(benchmark, folder, config=config, **options)
        assert run.is_complete and {flight["reason"] for flight in run.flights} == {"timeout"}
    table = compare_side_by_side(folders)
    assert table.planners == ("aero_mppi", "straight:Straight", "primitives")
    assert [one.flights for one in table.rows["few trees"]] == [2, 2, 2]
    content = run_json(capsys, "bench", "compare", *folders)
    assert [one["planner"] for one in content["runs"]] == list(table.planners) and len(content["comparisons"]) == 2
    pair = run_json(capsys, "bench", "compare", *folders[:2])
    assert pair["differences"]["planner"] == {"a": "aero_mppi", "b": "straight:Straight"}
    assert "one run only" in run_refused(capsys, "bench", "compare", folders[0])
    sudden = ["bench", "sudden", "--planner", "straight:Straight", "--output", str(tmp_path / "sudden")]
    assert "flies batches on the device" in run_refused(capsys, *sudden)


def test_a_flight_of_a_batch_is_the_single_flight():
    worlds = [World.from_dict({"name": f"w{i}", "start": [0, 0, 2], "goal": [4 + i, 0, 2]}) for i in range(2)]
    options = FlightOptions(lidar=LIDAR, rules=FlightRules(time_limit=5.0))
    batch = options.build(worlds, [StraightConfig()] * 2, [3, 4], threads=None)
    assert isinstance(batch, SerialFlights)
    results = batch.run()
    alone = fly(worlds[1], config=StraightConfig(), seed=4, lidar=LIDAR, rules=FlightRules(time_limit=5.0))
    assert all(result.arrived for result in results)
    assert dataclasses.replace(results[1], plan_ms_median=None) == dataclasses.replace(alone, plan_ms_median=None)


def test_its_parameters_are_tuned():
    worlds = [World.from_dict({"name": "w", "start": [0, 0, 2], "goal": [5, 0, 2]})] * 3
    config = StraightConfig.preset("soft")
    ranges = parse_ranges(["line.gain=0.4:4"], config)
    flight = FlightOptions(lidar=LIDAR, rules=FlightRules(time_limit=8.0))
    tuning = tune(config, ranges, worlds[:2], worlds[2:], search=SearchOptions(3, 3, 1), flight=flight)
    assert isinstance(tuning.chosen, StraightConfig) and len(tuning.candidates) == 4


def test_the_page_has_its_sliders_and_says_what_it_lacks():
    with small_session() as session:
        dashboard = Dashboard(session, port=0)
        try:
            changes = dashboard.changes(session.tick())
            layers = dashboard.layers
            assert not any(layers[name].available for name in ("anchors", "guides", "samples", "fine_cells", "motion"))
            assert layers["rollouts"].available
            texts = [value for _, name, value in changes if name == "content"]
            assert any("This planner has no samples, guides, anchors, cells, tracks." in text for text in texts)
            assert any("Cost (log)" in text for text in texts)
        finally:
            dashboard.close()
