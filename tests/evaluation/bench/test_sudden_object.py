import dataclasses
import itertools
import json

import numpy as np
import pytest
from command_line import run, run_refused

from aero_planner import PlannerConfig
from aero_viz.errors import UserError
from aero_viz.evaluation.bench import BENCHMARKS, run_benchmark
from aero_viz.evaluation.bench.report import write_report
from aero_viz.evaluation.bench.sudden_object import SIZE, SuddenObject, can_evade, check_arrival, open_field
from aero_viz.flight import FlightRules

VEHICLE = PlannerConfig().vehicle
SUDDEN = BENCHMARKS["sudden"]


def only(*labels):
    """Return the benchmark with these rows only."""
    rows = tuple(row for row in SUDDEN.rows if row.label in labels)
    assert len(rows) == len(labels)
    return dataclasses.replace(SUDDEN, rows=rows)


def test_rows_are_those_of_the_published_test():
    distances = set()
    for row in SUDDEN.rows:
        assert row.sudden is not None
        check_arrival(row.label, row.sudden, SUDDEN.worlds[row.label], FlightRules())
        distances.add(row.sudden.distance)
    assert distances == {0.5, 1.0, 1.5, 2.0, 2.5, 3.0}
    assert {row.speed for row in SUDDEN.rows} == {0.5, 1.0, 2.0, 3.0, 5.0, 7.0, 10.0}
    assert SIZE == (0.2, 0.2, 3.0)


def test_the_object_stands_at_its_distance_on_the_ground():
    world, _ = open_field(2.0)
    position = np.array([4.0, 0.3, 1.9])
    found = SuddenObject(3.4, 1.5).added_to(world, position, offset=0.05)
    assert found.distance(position[None])[0] == pytest.approx(1.5)
    assert found.distance([[5.6, 0.35, 2.9], [5.6, 0.35, 3.5]]) == pytest.approx([-0.1, 0.5])
    assert np.array_equal(found.bounds, world.bounds) and found.ground_height == world.ground_height == 0.0


def test_flights_evade_an_object_in_time_and_hit_one_that_is_too_late(tmp_path):
    benchmark = only("3 m at 2 m/s", "0.5 m at 10 m/s")
    options = {"flights": 1, "config": PlannerConfig.preset("fast-cpu"), "seed": 1}
    flown = run_benchmark(benchmark, tmp_path / "both", batch=2, **options)
    late, early = flown.flights
    assert (early["reason"], late["reason"]) == ("arrived", "collision")
    assert early["object_speed"] == pytest.approx(2.0, abs=0.3) and late["object_speed"] > 7.0
    assert early["length_m"] > SUDDEN.worlds["3 m at 2 m/s"].goal[0] - 1.5 and late["batch"] == early["batch"]
    alone = run_benchmark(benchmark, tmp_path / "alone", batch=1, **options)
    same = ("reason", "length_m", "min_clearance", "object_speed", "flight_time_s")
    assert [[f[key] for key in same] for f in alone.flights] == [[f[key] for key in same] for f in flown.flights]

    write_report(flown, tmp_path / "both")
    report = (tmp_path / "both" / "report.md").read_text(encoding="utf-8")
    assert "| velocity limit [m/s] | 10 | 2 |" in report and "| appears at 0.5 m | 0 x |  |" in report
    assert "| appears at 3 m |  | 100 |" in report and "x: a drone with this mass" in report
    assert f"| mean speed then [m/s] | {late['object_speed']:.1f} | {early['object_speed']:.1f} |" in report


def test_the_object_stands_elsewhere_with_another_seed(tmp_path):
    flown = run_benchmark(
        only("0.5 m at 2 m/s"),
        tmp_path / "out",
        flights=2,
        config=PlannerConfig().replace({"sampling.samples": 8, "sampling.steps": 10}),
        sensor={"points_per_sweep": 500},
    )
    first, second = (flight["min_clearance"] for flight in flown.flights)
    assert first != second and {f["world_seed"] for f in flown.flights} == {0, 1}


def test_what_can_be_evaded():
    def evades(distance, speed, **changes):
        return can_evade(distance, speed, vehicle=dataclasses.replace(VEHICLE, **changes), radius=0.25)

    assert evades(3.0, 0.5) and evades(0.5, 0.5) and not evades(0.5, 10.0)
    for distance, nearer in itertools.pairwise((3.0, 2.0, 1.0, 0.5)):
        for speed in (1.0, 2.0, 3.0, 5.0, 7.0, 10.0):
            assert evades(distance, speed) or not evades(nearer, speed)
    assert not evades(2.0, 7.0) and evades(2.0, 7.0, thrust_max=60.0, rate_xy_max=20.0)
    assert not evades(0.5, 5.0, thrust_max=5.0)  # does not even fly


def test_an_arrival_before_the_object_is_refused(tmp_path):
    with pytest.raises(UserError, match=r"'1 m at 3 m/s' .*arrival_radius is 8 m.*at most 6\.55 m"):
        run_benchmark(only("1 m at 3 m/s"), tmp_path / "out", rules=FlightRules(arrival_radius=8.0))
    assert not (tmp_path / "out").exists()


def test_cli(capsys, tmp_path, monkeypatch):
    monkeypatch.setitem(BENCHMARKS, "sudden", only("0.5 m at 0.5 m/s", "0.5 m at 7 m/s"))
    small = ["--sampling.samples", "8", "--sampling.steps", "10", "--lidar.points-per-sweep", "500"]
    folder = tmp_path / "out"
    arguments = ["bench", "sudden", "--flights", "1", "--rules.time-limit", "0.1", "--output", str(folder), *small]
    code, text, error = run(capsys, *arguments)
    assert (code, error) == (0, "") and text.splitlines()[0].split() == ["velocity", "limit", "[m/s]", "0.5", "7"]
    assert (folder / "success.png").stat().st_size > 0
    flights = [json.loads(line) for line in (folder / "flights.jsonl").read_text(encoding="utf-8").splitlines()]
    assert [flight["object_speed"] for flight in flights] == [None, None]  # too short to reach the place
    assert run(capsys, *arguments, "--resume")[0] == 0
    error = run_refused(capsys, *arguments, "--rules.arrival-radius", "8")
    assert "before it has passed the object" in error and error.count("\n") == 1
