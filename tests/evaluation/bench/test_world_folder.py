import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_line import run_refused
from PIL import Image

from aero_viz.errors import UserError
from aero_viz.evaluation.bench import Run
from aero_viz.evaluation.bench.difficulty_groups import DIFFICULTY, format_groups
from aero_viz.evaluation.bench.report import format_worlds, world_records, write_report
from aero_viz.evaluation.bench.world_folder import folder_benchmark
from aero_viz.scenes import scene


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Six forests, an image with its YAML file, and a file that is no world."""
    worlds = tmp_path / "worlds"
    worlds.mkdir()
    for trees in (0, 20, 40, 60, 80, 100):
        scene("forest", count=trees, seed=1).save(worlds / f"forest-{trees}.json")
    pixels = np.full((60, 120), 255, np.uint8)
    pixels[20:40, 50:60] = 0
    Image.fromarray(pixels).save(worlds / "maze.png")
    (worlds / "maze.yaml").write_text("image: maze.png\n", encoding="utf-8")
    (worlds / "notes.json").write_text("[]", encoding="utf-8")
    return worlds


def test_every_world_of_a_folder_is_a_row(folder: Path, caplog: pytest.LogCaptureFixture):
    benchmark = folder_benchmark(folder, speed=5.0)
    assert [row.label for row in benchmark.rows] == [
        *sorted(f"forest-{n}.json" for n in (0, 20, 40, 60, 80, 100)),
        "maze.png",
    ]
    np.testing.assert_array_equal(benchmark.worlds["forest-20.json"].goal, [45.0, 0.0, 2.0])
    maze = benchmark.worlds["maze.png"]
    assert maze.goal[0] - maze.start[0] > 8.0
    assert "notes.json is not a world" in caplog.text


def test_given_ends_hold_for_all_worlds(folder: Path):
    benchmark = folder_benchmark(folder, speed=5.0, start=(1.0, 2.0, 2.0), goal=(9.0, 2.0, 2.0))
    for world in benchmark.worlds.values():
        np.testing.assert_array_equal([world.start, world.goal], [[1.0, 2.0, 2.0], [9.0, 2.0, 2.0]])


def test_worlds_are_reported_by_difficulty(folder: Path, fly: Callable[..., Run], tmp_path: Path):
    run = fly("report", folder_benchmark(folder, speed=5.0), flights=1)
    assert len(run.flights) == 7
    records = world_records(run)
    difficulty = [record["difficulty"] for record in records]
    assert difficulty == sorted(difficulty)
    assert format_worlds(run)[0].startswith("forest-0.json: a path exists; traversability obstruction ")
    header, *thirds = format_groups(run)
    assert header[1] == "third"
    expected = [("easiest", "0/2"), ("middle", "0/2"), ("hardest", "0/3")]
    assert [(line[0], line[1], line[6]) for line in thirds] == [("all worlds", *counts) for counts in expected]
    write_report(run, tmp_path / "report")
    assert "## Success over difficulty" in (tmp_path / "report" / "report.md").read_text(encoding="utf-8")


def test_all_flights_through_a_world_are_in_the_same_third(folder: Path):
    benchmark = folder_benchmark(folder, speed=5.0)
    labels = [row.label for row in benchmark.rows]
    flights = [
        {**dict.fromkeys(DIFFICULTY, float(k)), "row": label, "world_seed": seed, "arrived": k == 0}
        for k, label in enumerate(labels)
        for seed in range(2)
    ]
    _, *thirds = format_groups(Run(benchmark, {}, flights))
    assert [(line[2], line[6]) for line in thirds] == [
        ("0.00 to 1.00", "2/4"),
        ("2.00 to 3.00", "0/4"),
        ("4.00 to 6.00", "0/6"),
    ]
    assert format_groups(Run(benchmark, {}, flights[:10])) == [], "five worlds"


def test_a_run_is_not_resumed_with_changed_worlds(folder: Path, fly: Callable[..., Run]):
    fly("again", folder_benchmark(folder, speed=5.0), flights=1)
    content = json.loads((folder / "forest-20.json").read_text(encoding="utf-8"))
    (folder / "forest-20.json").write_text(json.dumps({**content, "goal": [40.0, 0.0, 2.0]}), encoding="utf-8")
    with pytest.raises(UserError, match="cannot be resumed"):
        fly("again", folder_benchmark(folder, speed=5.0), flights=1, resume=True)


def test_the_plots_of_a_report_are_no_worlds(folder: Path, fly: Callable[..., Run], tmp_path: Path):
    write_report(fly("report"), tmp_path / "report")
    assert (tmp_path / "report" / "success.png").is_file()
    with pytest.raises(UserError, match="report has no worlds"):
        folder_benchmark(tmp_path / "report", speed=5.0)
    shutil.copy(folder / "forest-20.json", tmp_path / "report")
    shutil.copy(folder / "maze.png", folder / "success.png")
    assert [row.label for row in folder_benchmark(tmp_path / "report", speed=5.0).rows] == ["forest-20.json"]
    assert "success.png" in folder_benchmark(folder, speed=5.0).worlds


def test_a_report_is_not_written_among_the_worlds(folder: Path, capsys: pytest.CaptureFixture[str]):
    error = run_refused(capsys, "bench", "worlds", str(folder), "--output", str(folder / "."))
    assert "is the folder of the worlds, which a report could replace; choose another --output" in error


def test_a_folder_without_worlds_is_refused(tmp_path: Path):
    with pytest.raises(UserError, match="has no worlds"):
        folder_benchmark(tmp_path, speed=5.0)
    with pytest.raises(UserError, match="Cannot read the folder"):
        folder_benchmark(tmp_path / "none", speed=5.0)


def test_a_world_in_which_no_flight_can_arrive_is_refused_before_the_run(
    folder: Path, fly: Callable[..., Run], tmp_path: Path
):
    content = json.loads((folder / "forest-20.json").read_text(encoding="utf-8"))
    (folder / "forest-20.json").write_text(json.dumps({**content, "goal": [40.0, 0.0, -0.1]}), encoding="utf-8")
    with pytest.raises(UserError, match=r"Cannot fly 'forest-20.json': The goal \(40, 0, -0.1\) lies 0.10 m below"):
        fly("impossible", folder_benchmark(folder, speed=5.0), flights=1)
    assert not (tmp_path / "impossible").exists()
