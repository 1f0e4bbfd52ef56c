import csv
import json
import re
from dataclasses import replace

import pytest

from aero_viz.errors import UserError
from aero_viz.evaluation.bench.difficulty_groups import mean_std
from aero_viz.evaluation.bench.external_results import append_to_table, load_external_results
from aero_viz.evaluation.bench.report import OURS, format_summaries, write_report
from aero_viz.flight import FlightResult
from aero_viz.scenes import scene

PNG = b"\x89PNG\r\n"


def result(world: str, *, arrived: bool = True, speed: float = 2.0) -> FlightResult:
    return FlightResult(
        arrived=arrived,
        reason="arrived" if arrived else None,
        flight_time_s=20.0,
        mean_speed=speed,
        max_speed=3.0,
        end_speed=1.0,
        smoothness=50.0,
        length_m=46.0,
        mean_clearance=1.0,
        min_clearance=None,
        plan_ms_median=None,
        seed=0,
        scene=world,
        config="EGO",
    )


@pytest.fixture
def table(tmp_path):
    file = tmp_path / "ego.csv"
    append_to_table(result("forest-4-100"), file)
    append_to_table(result("forest-4-101", arrived=False, speed=9.0), file)
    return file


def test_report_has_all_files_and_numbers(fly, tmp_path, table):
    run = fly()
    external = load_external_results([f"EGO={table}"], run.benchmark)
    summaries = write_report(run, tmp_path / "out", external=external)
    assert [(line.row, line.planner, line.flights) for line in summaries] == [
        ("slow", OURS, 2),
        ("few samples", OURS, 2),
        ("fast", OURS, 2),
        ("forest-4", "EGO", 2),
    ]
    folder = tmp_path / "out"
    for name in ("success.png", "speed.png"):
        assert (folder / name).read_bytes().startswith(PNG)
    with (folder / "flights.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["length_m"]) for row in rows] == [flight["length_m"] for flight in run.flights]
    content = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    assert content["seed"] == 0 and content["complete"] and content["summary"][3]["success_rate"] == 0.5
    assert content["config"]["sampling"]["samples"] == 8
    report = (folder / "report.md").read_text(encoding="utf-8")
    assert "| forest-4 | EGO | 1/2 | 50 % | 9 to 91 % |  | 1 arrived, 1 incomplete |" in report
    assert "| slow | AERO-MPPI (paper), published | 5.60 | 7.74 |" in report
    assert re.search(r"\| slow \| 50 % at 1 m/s \| 0 % \(0 to \d+ %\) \| no \|", report)
    for name in ("warp-lang", "cores", "seeds of the worlds | from 100", "samples: 8"):
        assert name in report
    assert "Incomplete" not in report


def test_plots_do_not_follow_a_matplotlibrc(fly, tmp_path):
    import matplotlib

    (tmp_path / "matplotlibrc").write_text("text.usetex: True\ntext.latex.preamble: \\input{secret}\n")
    with matplotlib.rc_context(fname=tmp_path / "matplotlibrc"):
        write_report(fly(), tmp_path / "out")
        assert matplotlib.rcParams["text.usetex"]
    assert (tmp_path / "out" / "success.png").read_bytes().startswith(PNG)


def test_tables_have_one_value_per_cell_and_the_same_columns_without_failures(fly, tmp_path):
    run = fly()
    flights = [{**flight, "arrived": True, "batch": i, "batch_size": 1} for i, flight in enumerate(run.flights)]
    write_report(replace(run, flights=flights), tmp_path / "out")
    content = {}
    for name in ("summary", "flights"):
        with (tmp_path / "out" / f"{name}.csv").open(encoding="utf-8") as file:
            content[name] = list(csv.DictReader(file))
    first = content["summary"][0]
    assert float(first["plan_ms_min"]) <= float(first["plan_ms_median"]) <= float(first["plan_ms_max"])
    assert list(content["flights"][0])[-2:] == ["cause", "obstacle"] and not any("(" in v for v in first.values())


def test_a_deviation_by_rounding_is_none():
    assert mean_std([0.0871, 0.0871 + 4e-17]) == "0.0871 ± 0" and mean_std([1.0, 2.0]) == "1.5 ± 0.71"


def test_report_with_bars_and_without_external_flights(fly, tmp_path, benchmark_of_three):
    run = fly(benchmark=replace(benchmark_of_three, x_label=""))
    write_report(replace(run, flights=run.flights[:3]), tmp_path / "out")
    assert (tmp_path / "out" / "success.png").read_bytes().startswith(PNG)
    assert (tmp_path / "out" / "speed.png").read_bytes().startswith(PNG)  # with the published results
    report = (tmp_path / "out" / "report.md").read_text(encoding="utf-8")
    assert "(success.png)" in report and "(speed.png)" in report
    assert "Incomplete: 3 of 6" in (tmp_path / "out" / "report.md").read_text(encoding="utf-8")


def test_table_for_a_terminal(fly, tmp_path):
    lines = format_summaries(write_report(fly(), tmp_path / "out")).splitlines()
    assert lines[0].split() == ["row", "planner", "success", "95", "%", "interval", "passable", "mean", "speed",
                                "ended", "by"]  # fmt: skip
    assert "2 timeout" in lines[1] and "100 %" in lines[1] and len(lines) == 4


def test_external_trajectory_is_scored(tmp_path, benchmark_of_three):
    scene("forest", seed=3, count=4).save(tmp_path / "w.json")
    rows = [f"{t / 50},{t / 10},0,2" for t in range(100)]
    (tmp_path / "a.csv").write_text("t,x,y,z\n" + "\n".join(rows), encoding="utf-8")
    (external,) = load_external_results([f"IPC={tmp_path / 'a.csv'}@{tmp_path / 'w.json'}"], benchmark_of_three)
    assert (external.planner, external.label) == ("IPC", "forest-4")
    assert external.flights[0]["mean_speed"] == pytest.approx(5.0)


def test_unusable_external_results_are_refused(tmp_path, table, benchmark_of_three):
    def refusal(spec: str) -> str:
        with pytest.raises(UserError) as caught:
            load_external_results([spec], benchmark_of_three)
        return str(caught.value)

    assert "NAME=TABLE.csv" in refusal(str(table))
    assert "No such file" in refusal(f"EGO={tmp_path / 'none.csv'}")
    (tmp_path / "t.csv").write_text("t,x,y,z\n0,0,0,0\n", encoding="utf-8")
    assert "is a trajectory; give NAME=TABLE.csv" in refusal(f"EGO={tmp_path / 't.csv'}")
    (tmp_path / "other.csv").write_text("a,b\n1,2\n", encoding="utf-8")
    assert "lacks the column 'arrived'" in refusal(f"EGO={tmp_path / 'other.csv'}")
    text = table.read_text(encoding="utf-8")
    (tmp_path / "bad.csv").write_text(text.replace("20.0", "fast").replace("\n", "\n\n", 1), encoding="utf-8")
    assert "bad.csv, line 3: could not convert" in refusal(f"EGO={tmp_path / 'bad.csv'}")
    (tmp_path / "empty.csv").write_text(text.splitlines()[0] + "\n", encoding="utf-8")
    assert "holds no flights" in refusal(f"EGO={tmp_path / 'empty.csv'}")
    append_to_table(result("inclines-800-3"), table)
    assert "'inclines-800-3', which is not one of the benchmark small" in refusal(f"EGO={table}")


def test_table_of_another_kind_is_not_appended_to(tmp_path):
    (tmp_path / "other.csv").write_text("a,b\n1,2\n", encoding="utf-8")
    with pytest.raises(UserError, match="lacks the column"):
        append_to_table(result("w"), tmp_path / "other.csv")
    with pytest.raises(UserError, match="Cannot write the table"):
        append_to_table(result("w"), tmp_path / "none" / "t.csv")


def test_flights_of_another_run_can_be_external_results(fly, tmp_path):
    run = fly()
    write_report(run, tmp_path / "out")
    results = load_external_results([f"before={tmp_path / 'out' / 'flights.csv'}"], run.benchmark)
    assert {result.label: len(result.flights) for result in results} == {"slow": 2, "few samples": 2, "fast": 2}
    others = replace(run.benchmark, rows=tuple(replace(row, label=f"new {row.label}") for row in run.benchmark.rows))
    results = load_external_results([f"before={tmp_path / 'out' / 'flights.csv'}"], others)
    assert {result.label: len(result.flights) for result in results} == {"forest-4": 4, "verticals-5": 2}


def test_external_flights_in_worlds_that_the_run_does_not_have_are_left_out(table, benchmark_of_three, caplog):
    (external,) = load_external_results([f"EGO={table}"], benchmark_of_three, seeds=range(101, 103))
    assert [flight["scene"] for flight in external.flights] == ["forest-4-101"]
    assert "left out: 1 flights of" in caplog.text
    with pytest.raises(UserError, match="has no flight in the worlds of this run; fly the same --seed and --flights"):
        load_external_results([f"EGO={table}"], benchmark_of_three, seeds=range(2))


def test_table_keeps_its_columns_when_a_flight_is_appended(tmp_path, benchmark_of_three):
    """A table of an earlier version has no explanations, and its columns are in another order."""
    file = tmp_path / "old.csv"
    append_to_table(result("forest-4-100"), file)
    header, line = (row.split(",") for row in file.read_text(encoding="utf-8").splitlines())
    kept = [i for i in reversed(range(len(header))) if header[i] != "explanation"]
    file.write_text("".join(",".join(row[i] for i in kept) + "\n" for row in (header, line)), encoding="utf-8")
    append_to_table(replace(result("forest-4-101", speed=9.0), explanation="It ends, somewhere."), file)
    (external,) = load_external_results([f"EGO={file}"], benchmark_of_three)
    assert [flight["mean_speed"] for flight in external.flights] == [2.0, 9.0]
    assert [flight["scene"] for flight in external.flights] == ["forest-4-100", "forest-4-101"]
