import dataclasses
import json

import pytest

from aero_planner import PlannerConfig
from aero_viz.errors import UserError
from aero_viz.evaluation.bench import BENCHMARKS, Benchmark, Row
from aero_viz.evaluation.bench.report import write_report
from aero_viz.evaluation.bench.runner import STAGE_FIELD, BenchmarkInterrupted
from aero_viz.flight import FlightRules, StateNoise, VehicleModel
from aero_viz.flight import fly as fly_once
from aero_viz.scenes import scene
from aero_viz.sensors import LIDARS

TIMING = ("plan_ms_median", "build_s", "run_s", "batch", "batch_size")


def without_timing(run):
    kept = [{key: value for key, value in flight.items() if key not in TIMING} for flight in run.flights]
    return sorted(kept, key=lambda flight: (flight["row"], flight["index"]))


def test_rows_of_equal_structure_share_batches(fly):
    run = fly(batch=4)
    assert run.is_complete and len(run.flights) == 6
    batches = {}
    for flight in run.flights:
        batches.setdefault(flight["batch"], []).append(flight["row"])
    assert list(batches.values()) == [["slow", "slow", "fast", "fast"], ["few samples", "few samples"]]
    assert [flight["seed"] for flight in run.flights] == [100, 101, 102, 103, 104, 105]
    assert [flight["world_seed"] for flight in run.flights] == [100, 101] * 3
    assert {flight["scene"] for flight in run.flights if flight["row"] == "fast"} == {
        "verticals-5-100",
        "verticals-5-101",
    }


def test_batches_do_not_change_flights(fly):
    assert without_timing(fly("one", batch=1)) == without_timing(fly("all", batch=256))


def test_flight_equals_that_of_fly(fly):
    run = fly()
    flight = next(flight for flight in run.flights if flight["row"] == "fast" and flight["index"] == 1)
    alone = fly_once(
        scene("verticals", count=5, seed=flight["world_seed"]),
        config=PlannerConfig.from_dict(run.header["config"]),
        seed=flight["seed"],
        lidar=dataclasses.replace(LIDARS["mid360"], points_per_sweep=500),
        rules=FlightRules(time_limit=0.2),
        speed=7.0,
    )
    assert (flight["length_m"], flight["smoothness"]) == (alone.length_m, alone.smoothness)


def test_disturbances_reach_the_flights(fly):
    options = {
        "drone": {"drag": 0.4, "gust_speed": 3.0},
        "noise": StateNoise(position=0.1),
        "rules": FlightRules(time_limit=0.4, ticks_per_plan=5),
    }
    run = fly(**options)
    flight = next(flight for flight in run.flights if flight["row"] == "fast" and flight["index"] == 1)
    config = PlannerConfig.from_dict(run.header["config"])
    alone = fly_once(
        scene("verticals", count=5, seed=flight["world_seed"]),
        config=config,
        seed=flight["seed"],
        lidar=dataclasses.replace(LIDARS["mid360"], points_per_sweep=500),
        vehicle=VehicleModel.from_config(config, **options["drone"]),
        noise=options["noise"],
        rules=options["rules"],
        speed=7.0,
    )
    assert (flight["length_m"], flight["smoothness"]) == (alone.length_m, alone.smoothness)
    assert without_timing(run) != without_timing(fly("calm", rules=FlightRules(time_limit=0.4)))
    assert run.header["simulation"]["drone"] == options["drone"]


def test_arrival_radius_of_a_row_overrides_that_of_the_rules(fly, benchmark_of_three):
    rows = (Row("far", "forest", 4), Row("near", "forest", 4, arrival_radius=0.5))
    wide = FlightRules(time_limit=0.2, arrival_radius=50.0)
    run = fly(benchmark=dataclasses.replace(benchmark_of_three, rows=rows), flights=1, rules=wide)
    assert {flight["row"]: flight["reason"] for flight in run.flights} == {"far": "arrived", "near": "timeout"}


def test_interrupted_run_keeps_finished_batches_and_resumes(fly):
    def interrupt(finished, total, text):
        if finished == 2 and "0.1 s, 0 of 1 finished" in text:
            raise KeyboardInterrupt

    with pytest.raises(BenchmarkInterrupted) as caught:
        fly("cut", batch=1, progress=interrupt)
    kept = caught.value.run
    assert len(kept.flights) == 2 and kept.total == 6 and not kept.is_complete
    calls = []
    resumed = fly("cut", batch=2, resume=True, progress=lambda finished, total, text: calls.append((finished, total)))
    assert calls[0] == (2, 6) and calls[-1] == (6, 6)
    assert resumed.flights[:2] == kept.flights and resumed.header["date"] == kept.header["date"]
    assert without_timing(resumed) == without_timing(fly("whole"))


def test_torn_last_line_is_flown_again(fly, tmp_path):
    whole = fly("torn", batch=1)
    file = tmp_path / "torn" / "flights.jsonl"
    file.write_text(file.read_text(encoding="utf-8")[:-40], encoding="utf-8")
    assert without_timing(fly("torn", batch=1, resume=True)) == without_timing(whole)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"seed": 1}, "seed was 0 and is 1"),
        ({"flights": 3}, "flights was 2 and is 3"),
        ({"lidar": "full-sphere"}, "lidar was None and is 'full-sphere'"),
        ({"config": None}, "config.sampling.samples was 8 and is 256"),
        ({"drone": {"drag": 0.1}}, "simulation.drone.drag was None and is 0.1"),
        ({"sensor": {"points_per_sweep": 400}}, "simulation.lidar.points_per_sweep was 500 and is 400"),
        ({"noise": StateNoise(position=0.1)}, "simulation.noise was None and is"),
        ({"rules": FlightRules(time_limit=0.3)}, "simulation.rules.time_limit was 0.2 and is 0.3"),
    ],
)
def test_resume_refuses_other_options(fly, options, reason):
    fly()
    with pytest.raises(UserError, match=reason):
        fly(resume=True, **options)


def test_resume_refuses_other_rows_and_versions(fly, tmp_path, benchmark_of_three):
    fly()
    with pytest.raises(UserError, match="rows differ"):
        fly(benchmark=dataclasses.replace(benchmark_of_three, rows=benchmark_of_three.rows[:2]), resume=True)
    file = tmp_path / "out" / "run.json"
    header = json.loads(file.read_text(encoding="utf-8"))
    header["versions"]["aero-viz"] = "0.0.1"
    file.write_text(json.dumps(header), encoding="utf-8")
    with pytest.raises(UserError, match=r"versions.aero-viz was '0.0.1' and is"):
        fly(resume=True)


def test_results_are_not_overwritten(fly):
    fly()
    with pytest.raises(UserError, match="add --resume to continue, or choose another --output"):
        fly()


def test_user_errors(fly, tmp_path):
    with pytest.raises(UserError, match="at least 1"):
        fly(flights=0)
    wrong = Benchmark("w", "W", "", (Row("r", "forest", changes={"sampling.samples": 0}),))
    with pytest.raises(UserError, match=r"'r' of w does not fit the configuration: sampling.samples"):
        fly(benchmark=wrong)
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(UserError, match=r"Cannot write the results .* Choose another --output\."):
        fly("file/below")


def test_scaling_flies_each_row_in_one_batch_and_times_its_stages(fly, tmp_path):
    scaling = BENCHMARKS["scaling"]
    small = [dataclasses.replace(row, batch=size, count=2) for row, size in zip(scaling.rows[:2], (1, 3), strict=True)]
    run = fly(benchmark=dataclasses.replace(scaling, rows=tuple(small)), batch=2)
    assert [(flight["row"], flight["batch"], flight["batch_size"]) for flight in run.flights] == [
        ("batch 1", 0, 1),
        *[("batch 16", 1, 3)] * 3,
    ]
    assert [flight["world_seed"] for flight in run.flights] == [0, 0, 1, 0]
    for flight in run.flights:
        stages = {name: ms for name, ms in flight.items() if name.startswith(STAGE_FIELD)}
        assert {f"{STAGE_FIELD}{name}" for name in ("planner", "planner.partition", "lidar", "vehicle")} <= set(stages)
        assert all(ms > 0.0 for ms in stages.values())
    report = tmp_path / "report"
    write_report(run, report)
    assert "| planner.partition | " in (report / "report.md").read_text(encoding="utf-8")
