"""`aero-viz fly`. `aero-viz score` is tested with the evaluation package."""

import csv
import json
import re
import signal
from pathlib import Path

import numpy as np
import pytest
from command_line import run, run_in_terminal, run_json, run_refused
from mcap.reader import make_reader

from aero_viz.recordings import inspect as inspect_recording

FLIGHT_FIELDS = {
    "arrived", "reason", "flight_time_s", "mean_speed", "max_speed", "end_speed", "smoothness", "length_m",
    "mean_clearance", "min_clearance", "plan_ms_median", "seed", "scene", "config", "explanation",
}  # fmt: skip

DISTURBED = [
    "--drone.drag", "0.3", "--drone.gust-speed", "1", "--drone.gust-time", "0.5", "--drone.latency", "0.02",
    "--drone.thrust-lag", "0.03", "--drone.rate-lag", "0.02", "--noise.position", "0.03", "--noise.velocity", "0.05",
    "--noise.attitude", "0.5", "--rules.ticks-per-plan", "5", "--lidar.range-max", "20", "--lidar.range-noise", "0.05",
    "--lidar.dropout", "0.1", "--sampling.samples", "16",
]  # fmt: skip


def test_fly_prints_the_result_and_writes_the_trajectory(
    capsys: pytest.CaptureFixture[str], poles: str, tmp_path: Path
):
    path = tmp_path / "flight.csv"
    result = run_json(
        capsys, "fly", poles, "--speed", "4", "--seed", "3", "--sampling.samples", "16", "--trajectory", str(path)
    )
    assert set(result) >= FLIGHT_FIELDS
    assert result["arrived"] and result["reason"] == "arrived"
    assert result["max_speed"] < 5.0
    rows = list(csv.DictReader(path.open()))
    assert list(rows[0]) == ["t", "x", "y", "z", "vx", "vy", "vz"]
    assert float(rows[-1]["t"]) == pytest.approx(result["flight_time_s"])
    steps = np.diff([[float(row[axis]) for axis in "xyz"] for row in rows], axis=0)
    assert np.linalg.norm(steps, axis=1).sum() == pytest.approx(result["length_m"], rel=1e-3)


def test_the_text_has_the_units_that_no_name_says(capsys: pytest.CaptureFixture[str], short_poles: str):
    code, text, _ = run(capsys, "fly", short_poles, "--sampling.samples", "16")
    assert code == 0
    shown = {name: unit for name, _, *unit in map(str.split, text.splitlines())}
    assert shown["mean_speed"] == shown["max_speed"] == shown["end_speed"] == ["m/s"]
    assert shown["mean_clearance"] == shown["min_clearance"] == ["m"] and shown["smoothness"] == ["m^2/s^5"]
    assert shown["flight_time_s"] == shown["plan_ms_median"] == shown["seed"] == []


def test_fly_reads_presets_and_files(capsys: pytest.CaptureFixture[str], short_poles: str, tmp_path: Path):
    path = tmp_path / "tuned.yaml"
    path.write_text("preset: paper\nsampling:\n  samples: 16\n")
    result = run_json(capsys, "fly", short_poles, "--config", str(path), "--seed", "1")
    assert result["config"] == str(path)


@pytest.mark.parametrize(
    ("flags", "name"),
    [
        (("--config", "paper", "--costs.q-track", "8"), "paper, changed"),
        (("--speed", "3"), "default, changed"),
        (("--speed", "7"), "default"),
    ],
)
def test_the_result_says_that_flags_changed_the_preset(
    capsys: pytest.CaptureFixture[str], short_poles: str, flags: tuple[str, ...], name: str
):
    assert run_json(capsys, "fly", short_poles, "--rules.time-limit", "0.02", *flags)["config"] == name


def test_a_collision_is_a_result_not_an_error(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    path = tmp_path / "inside.json"
    path.write_text(json.dumps({"name": "inside", "start": [0, 0, 2], "goal": [9, 0, 2], "spheres": [[0, 0, 2, 1.0]]}))
    result = run_json(capsys, "fly", str(path))
    assert result["reason"] == "collision"
    assert result["explanation"] == "The start is inside an obstacle, 1.000 m deep in sphere 0, at (0, 0, 2)."


def test_disturbances_reach_the_flight_and_its_log(capsys: pytest.CaptureFixture[str], poles: str, tmp_path: Path):
    """The same flags give the same disturbed flight with and without a log, and the log contains each flag."""
    files = [str(tmp_path / name) for name in ("a.csv", "b.csv", "c.csv")]
    calm = run_json(capsys, "fly", poles, "--sampling.samples", "16", "--trajectory", files[0])
    plain = run_json(capsys, "fly", poles, *DISTURBED, "--trajectory", files[1])
    log = str(tmp_path / "flight.mcap")
    logged = run_json(capsys, "fly", poles, *DISTURBED, "--trajectory", files[2], "--log", log)
    for result in (calm, plain, logged):
        result.pop("plan_ms_median")
    assert plain == logged != calm
    assert Path(files[1]).read_text() == Path(files[2]).read_text() != Path(files[0]).read_text()
    with open(log, "rb") as file:
        attached = {item.name: item.data for item in make_reader(file).iter_attachments()}
    settings = json.loads(attached["flight.json"])
    for flag, value in zip(DISTURBED[:-2:2], DISTURBED[1:-2:2], strict=True):
        section, name = flag.removeprefix("--").replace("-", "_").split(".")
        assert settings[section][name] == float(value), flag
    assert (settings["seed"], settings["device"]) == (0, "cpu")


def test_start_and_goal_of_any_world_are_flags(capsys: pytest.CaptureFixture[str], poles: str, tmp_path: Path):
    path = tmp_path / "flight.csv"
    endpoints = ["--start", "0", "-1", "2", "--goal", "8", "1.5", "2"]
    result = run_json(capsys, "fly", poles, *endpoints, "--sampling.samples", "16", "--trajectory", str(path))
    rows = [[float(row[axis]) for axis in "xyz"] for row in csv.DictReader(path.open())]
    assert result["arrived"] and rows[0] == [0.0, -1.0, 2.0]
    assert np.linalg.norm(np.array(rows[-1]) - [8.0, 1.5, 2.0]) <= 1.0


def test_the_voxel_size_of_a_map_is_a_flag(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    path = str(tmp_path / "hall.npy")
    floor = np.stack(np.meshgrid(np.arange(-3, 15, 0.2), np.arange(-4, 4, 0.2), [0.0]), axis=-1).reshape(-1, 3)
    pole = np.stack(np.meshgrid([5.0, 5.2], [0.6, 0.8], np.arange(0, 5, 0.2)), axis=-1).reshape(-1, 3)
    np.save(path, np.vstack([floor, pole]))
    endpoints = ["--start", "0", "0", "2", "--goal", "10", "0", "2"]
    result = run_json(capsys, "fly", path, *endpoints, "--voxel", "0.4", "--speed", "4", "--sampling.samples", "16")
    assert result["arrived"] and result["scene"] == "hall"
    for voxel in ("0.2", "0.4"):
        run(capsys, "world", "export", path, str(tmp_path / "w.json"), *endpoints, "--voxel", voxel, "--overwrite")
        world = json.loads((tmp_path / "w.json").read_text())
        assert world["start"] == [0.0, 0.0, 2.0]
        assert min(box[5] for box in world["boxes"]) == pytest.approx(float(voxel))


def test_progress_is_shown_on_a_terminal_but_not_with_json(short_poles: str):
    code, printed, shown = run_in_terminal("fly", short_poles, "--sampling.samples", "16")
    assert code == 0 and "reason           arrived" in printed
    assert "poles" in shown and "% of the distance" in shown
    code, printed, shown = run_in_terminal("fly", short_poles, "--sampling.samples", "16", "--json")
    assert (code, shown) == (0, "") and json.loads(printed)["arrived"]


@pytest.mark.parametrize(("is_logged", "number"), [(False, signal.SIGTERM), (True, signal.SIGINT)])
def test_ctrl_c_and_sigterm_print_the_result_so_far(tmp_path: Path, is_logged: bool, number: signal.Signals):
    log = tmp_path / "flight.mcap"
    options = ["--trajectory", str(tmp_path / "t.csv"), *(["--log", str(log)] if is_logged else [])]
    code, printed, _ = run_in_terminal(
        *("fly", "forest", "--count", "20", "--sampling.samples", "16", *options),
        interrupt_at=lambda shown: bool(re.search(r"[1-9]\d*\.\d s flown", shown)),
        interrupt_by=number,
    )
    result = dict(line.split(maxsplit=1) for line in printed.splitlines())
    assert code == 130 and result["arrived"] == "False" and "reason" not in result
    assert result["explanation"].startswith("The flight was not over after")
    rows = list(csv.DictReader((tmp_path / "t.csv").open()))
    assert float(rows[-1]["t"]) == pytest.approx(float(result["flight_time_s"]), abs=1e-3)
    if is_logged:
        info = inspect_recording(log)
        assert info.problems == () and info.poses == len(rows)


def test_the_default_forest_is_flown_without_a_collision(capsys: pytest.CaptureFixture[str]):
    result = run_json(capsys, "fly", "forest")
    assert result["reason"] == "arrived"
    assert result["min_clearance"] > 0.25


def test_a_malformed_world_is_reported_with_file_and_key(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    path = tmp_path / "bad.json"
    path.write_text(json.dumps({"name": "bad", "start": [0, 0, 2], "goal": [9, 0, 2], "spheres": [[0, 0, 2]]}))
    error = run_refused(capsys, "fly", str(path))
    assert "spheres" in error and "bad.json" in error
