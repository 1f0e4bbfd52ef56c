from __future__ import annotations

import json

import pytest

from aero_viz.cli import main

SMALL = ["--sampling.samples", "8", "--sampling.steps", "10"]


def run(capsys, *arguments: str) -> tuple[int, str, str]:
    code = 0
    try:
        main(list(arguments))
    except SystemExit as end:
        code = int(end.code or 0)
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_fly_export_score_and_include(capsys, tmp_path):
    """What a user of another planner does, from the world to the plot."""
    world, csv_file, table = str(tmp_path / "w.json"), str(tmp_path / "f.csv"), str(tmp_path / "ego.csv")
    assert run(capsys, "world", "export", "wall", world, "--seed", "1")[0] == 0
    code, text, _ = run(capsys, "fly", world, "--speed", "2", "--json", "--trajectory", csv_file, *SMALL)
    assert code == 0
    flown = json.loads(text)
    code, text, _ = run(capsys, "score", csv_file, "--world", world, "--planner", "EGO", "--table", table, "--json")
    assert code == 0
    scored = json.loads(text)
    assert scored["reason"] == flown["reason"] and scored["config"] == "EGO"
    assert scored["length_m"] == pytest.approx(flown["length_m"], rel=1e-4)

    folder = tmp_path / "rooms"
    wanted = ["bench", "rooms", "--flights", "1", "--output", str(folder), "--include", f"EGO={table}", *SMALL]
    code, text, error = run(capsys, *wanted)
    assert (code, error) == (0, "")
    assert "double_wall_trap" in text and "EGO" in text and str(folder / "report.md") in text
    code, text, _ = run(capsys, *wanted, "--resume", "--json")
    summary = json.loads(text)["summary"]
    assert code == 0 and [line["planner"] for line in summary] == ["AERO-Viz"] * 4 + ["EGO"]
    code, _, error = run(capsys, *wanted)
    assert code == 2 and "--resume" in error and error.count("\n") == 1


def test_points_of_a_world(capsys, tmp_path):
    code, text, _ = run(capsys, "world", "export", "wall", str(tmp_path / "w.pcd"), "--spacing", "0.3")
    points = int(text.split()[1])
    assert code == 0 and (tmp_path / "w.pcd").stat().st_size == pytest.approx(12 * points, abs=250)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["world", "export", "wall", "w.doc"], "must end with"),
        (["score", "none.csv", "--world", "wall"], "Cannot read the trajectory none.csv"),
        (["bench", "rooms", "--include", "EGO"], "NAME=TABLE.csv"),
        (["bench", "rooms", "--flights", "0"], "at least 1"),
        (["score", "none.csv", "--world", "wall", "--radius", "-1"], "radius"),
    ],
)
def test_mistakes_exit_with_2_and_one_line(capsys, arguments, said):
    code, text, error = run(capsys, *arguments)
    assert code == 2 and text == "" and said in error and error.count("\n") == 1
