import json
import re
import signal
import subprocess
import sys
import time

import pytest
from command_line import run, run_json, run_refused

from aero_viz.evaluation.bench import BENCHMARKS, Benchmark, Row
from aero_viz.scenes import scene
from aero_viz.scenes.passable import is_passable

SMALL = ["--sampling.samples", "8", "--sampling.steps", "10"]


def test_fly_export_score_and_include(capsys, tmp_path):
    """The whole way of another planner's flight, from the world to the plot."""
    world, csv_file, table = str(tmp_path / "w.json"), str(tmp_path / "f.csv"), str(tmp_path / "ego.csv")
    assert run(capsys, "world", "export", "wall", world, "--seed", "0")[0] == 0
    flown = run_json(capsys, "fly", world, "--speed", "4", "--trajectory", csv_file, *SMALL)
    scored = run_json(capsys, "score", csv_file, "--world", world, "--planner", "EGO", "--table", table)
    assert scored["reason"] == flown["reason"] and scored["config"] == "EGO"
    assert scored["length_m"] == pytest.approx(flown["length_m"], rel=1e-4)

    folder = tmp_path / "rooms"
    short = ["--flights", "1", "--rules.time-limit", "0.5", "--lidar.points-per-sweep", "500", "--no-causes"]
    arguments = ["bench", "rooms", *short, "--output", str(folder), "--include", f"EGO={table}", *SMALL]
    code, text, error = run(capsys, *arguments)
    assert (code, error) == (0, "")
    assert "double_wall_trap" in text and "EGO" in text and str(folder / "report.md") in text
    summary = run_json(capsys, *arguments, "--resume")["summary"]
    assert [line["planner"] for line in summary] == ["AERO-Viz"] * 8 + ["EGO"]
    error = run_refused(capsys, *arguments)
    assert "add --resume to continue" in error and error.count("\n") == 1


def test_ctrl_c_keeps_flights_and_resume_flies_the_rest(capsys, tmp_path):
    """SIGINT during the flights: finished ones are kept, and the resumed run equals an uninterrupted one."""

    def arguments(folder):
        short = ["--flights", "2", "--batch", "1", "--rules.time-limit", "0.5", "--lidar.points-per-sweep", "500"]
        quick = ["--no-examine", "--no-causes", *SMALL]
        return ["bench", "rooms", *short, "--output", str(folder), "--drone.drag", "0.2", *quick]

    cut, whole = tmp_path / "cut", tmp_path / "whole"
    command = [sys.executable, "-m", "aero_viz", *arguments(cut), "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        while not ((cut / "flights.jsonl").exists() and (cut / "flights.jsonl").read_bytes().count(b"\n") >= 2):
            assert process.poll() is None
            time.sleep(0.01)
        process.send_signal(signal.SIGINT)
        text, error = process.communicate(timeout=60)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 130, error
    kept, content = int(error.split()[0]), json.loads(text)
    assert content["interrupted"] and sum(line["flights"] for line in content["summary"]) == kept
    assert (
        2 <= kept < 16
        and f"{kept} of 16 flights are kept in {cut}; run the same command with --resume" in error
        and error.count("\n") == 1
    )
    assert f"Incomplete: {kept} of 16 flights" in (cut / "report.md").read_text()
    assert not run_json(capsys, *arguments(cut), "--resume")["interrupted"]
    assert run(capsys, *arguments(whole))[0] == 0
    assert untimed(cut) == untimed(whole) and len(untimed(whole)) == 16


def test_ctrl_c_before_the_first_flight_ends_quietly(capsys, tmp_path, monkeypatch):
    def interrupt(device):
        raise KeyboardInterrupt

    monkeypatch.setattr("aero_viz.evaluation.bench.runner.hardware", interrupt)
    assert run(capsys, "bench", "rooms", "--output", str(tmp_path / "out")) == (130, "", "")
    assert not (tmp_path / "out").exists()


def untimed(folder):
    """Return all flights without what depends on the machine."""
    flights = map(json.loads, (folder / "flights.jsonl").read_text().splitlines())
    timed = ("plan_ms_median", "build_s", "run_s", "batch")
    return {(f["row"], f["index"]): {key: f[key] for key in f if key not in timed} for f in flights}


def test_report_says_for_every_world_whether_it_has_a_path(capsys, tmp_path, monkeypatch):
    rows = (Row("few", "verticals", 5), Row("dense", "verticals", 1000))
    small = Benchmark("rooms", "Two fields", "For tests.", rows, first_seed=14)
    monkeypatch.setitem(BENCHMARKS, "rooms", small)
    # There is a path for this radius in only some of the dense worlds.
    options = ["--rules.radius", "0.5", "--rules.time-limit", "0.1", "--lidar.points-per-sweep", "500", *SMALL]
    code, text, _ = run(capsys, "bench", "rooms", "--flights", "3", "--output", str(tmp_path / "a"), *options)
    passable = {seed: is_passable(scene("verticals", count=1000, seed=seed), radius=0.5) for seed in (14, 15, 16)}
    none = ", ".join(str(seed) for seed, found in passable.items() if not found)
    assert code == 0 and none
    line = "verticals-5, seeds 14 to 16: a path exists in 3 of 3 worlds; traversability obstruction "
    assert re.search(line + r"[\d.]+ ± [\d.]+, view occlusion [\d.]+ ± ", text)
    line = f"verticals-1000, seeds 14 to 16: a path exists in {sum(passable.values())} of 3 worlds, none with the seeds"
    assert f"{line} {none}\n" in text and f"- {line} {none}\n" in (tmp_path / "a" / "report.md").read_text()
    worlds = (tmp_path / "a" / "worlds.csv").read_text().splitlines()
    difficulty = "traversability_obstruction,view_occlusion,angle_over_length,guide_length,difficulty"
    assert worlds[0] == f"kind,seed,passable,{difficulty}"
    assert any(row.startswith(f"verticals-1000,14,{passable[14]},") for row in worlds)


def test_points_of_a_world(capsys, tmp_path):
    code, text, _ = run(capsys, "world", "export", "wall", str(tmp_path / "w.pcd"), "--spacing", "0.3")
    points = int(text.split()[1])
    assert code == 0 and (tmp_path / "w.pcd").stat().st_size == pytest.approx(12 * points, abs=250)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["world", "export", "wall", "w.doc"], "must end with"),
        (["score", "none.csv", "--world", "wall"], "Cannot read the trajectory none.csv"),
        (["bench", "rooms", "--include", "EGO"], "NAME=TABLE.csv"),
        (["bench", "rooms", "--flights", "0"], "at least 1"),
        (["bench", "rooms", "--flights", "100001"], "--flights is 100001; it must be at most 100000"),
        (["bench", "rooms", "--output", __file__], "is a file; give --output the name of a folder"),
        (["bench", "rooms", "--seed", "-1"], "--seed is -1; it must be in [0, 2^32 - 1]"),
        (["bench", "table2", "--lidar.dropout", "2"], "lidar.dropout is 2"),
        (["score", "none.csv", "--world", "wall", "--rules.radius", "-1"], "rules.radius is -1"),
    ],
)
def test_mistakes_exit_with_2_and_one_line(capsys, arguments, message):
    error = run_refused(capsys, *arguments)
    assert message in error and error.count("\n") == 1
