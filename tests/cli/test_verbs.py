"""The command line as a user calls it."""

from __future__ import annotations

import csv
import json
import os
import signal
import socket
import subprocess
import sys
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from playwright.sync_api import Browser
from small_source import small_source

from aero_planner.config import parameters
from aero_viz.cli import main
from aero_viz.recordings import inspect as inspect_recording
from tests.planner.interruption import interrupted_at_import

FLIGHT_FIELDS = {
    "arrived", "reason", "flight_time_s", "mean_speed", "max_speed", "smoothness", "length_m", "mean_clearance",
    "min_clearance", "plan_ms_median", "seed", "scene", "config", "explanation",
}  # fmt: skip


@pytest.fixture
def poles(tmp_path: Path) -> str:
    """World file with three poles."""
    world = small_source().scenery.world
    assert world is not None
    path = tmp_path / "poles.json"
    world.save(path)
    return str(path)


def run_json(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    capsys.readouterr()  # what fixtures printed
    main([*arguments, "--json"])
    return json.loads(capsys.readouterr().out)


def run_refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    capsys.readouterr()  # what fixtures printed
    with pytest.raises(SystemExit) as exit:
        main(list(arguments))
    assert exit.value.code == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "Traceback" not in captured.err
    return captured.err


def test_fly_reports_and_writes_the_trajectory(capsys: pytest.CaptureFixture[str], poles: str, tmp_path: Path) -> None:
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


def test_fly_takes_presets_files_and_flags(capsys: pytest.CaptureFixture[str], poles: str, tmp_path: Path) -> None:
    path = tmp_path / "tuned.yaml"
    path.write_text("preset: paper\nsampling:\n  samples: 16\n")
    result = run_json(capsys, "fly", poles, "--config", str(path), "--seed", "1")
    assert result["config"] == str(path)


def test_a_collision_is_a_result_not_an_error(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "inside.json"
    path.write_text(json.dumps({"name": "inside", "start": [0, 0, 2], "goal": [9, 0, 2], "spheres": [[0, 0, 2, 1.0]]}))
    result = run_json(capsys, "fly", str(path))
    assert result["reason"] == "collision"
    assert result["explanation"] == 'The start is inside an obstacle, 1.000 m deep in "spheres" row 0, at (0, 0, 2).'


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fly", "forrest"], "forest"),
        (["fly", "forest", "--config", "papr"], "paper"),
        (["fly", "forest", "--costs.q-track", "-3"], "costs.q_track is -3"),
        (["fly", "forest", "--device", "cuda:77"], "cuda:77"),
        (["fly", "forest", "--speed", "-1"], "speed_limit"),
        (["fly", "forest", "--sampling.samples", "many"], "samples"),
        (["fly", "missing.json"], "missing.json"),
        (["inspect", "missing.bag"], "missing.bag"),
        (["play", "missing.bag"], "missing.bag"),
        (["play", "world.json"], "aero-viz demo world.json"),
        (["play", "forest"], "forest is a scene, not a recording; fly it with: aero-viz demo forest"),
        (["demo", "--host", "203.0.113.7"], "no address of this machine; choose another one with --host"),
        (["fly", "forest", "--speed", "abc"], "--speed: 'abc' is no number"),
        (["snapshot", "forest", "/"], "/ cannot be written: it is a folder"),
        (["demo", "forrest"], "forest"),
        (["snapshot", "forrest", "out.png"], "forest"),
        (["nonsense"], "nonsense"),
        (["fly", "forest", "--noise.position", "-1"], "noise.position is -1.0; it must be a number in [0, 100] m"),
        (["fly", "forest", "--drone.drag", "1e3"], "drone.drag is 1000.0"),
        (["fly", "forest", "--drone.gust-speed", "2"], "set drone.drag too"),
        (["fly", "forest", "--lidar.range-max", "0.1"], "lidar.range_min is 0.1; it must be less than lidar.range_max"),
        (["fly", "forest", "--lidar.dropout", "2"], "lidar.dropout is 2.0; it must be a number in [0, 1]"),
        (["fly", "forest", "--rules.ticks-per-plan", "0"], "rules.ticks_per_plan is 0"),
        (["fly", "forest", "--rules.period", "0.03"], "no multiple of the tick"),
        (["demo", "forest", "--noise.attitude", "999"], "noise.attitude is 999.0"),
        (["bench", "rooms", "--drone.latency", "-1"], "drone.latency is -1.0"),
        (["fly", "forest", "--drone.drg", "1"], "did you mean --drone.drag?"),
        (["fly", "forest", "--goal", "30", "0", "-0.2"], "goal (30, 0, -0.2) lies inside an obstacle"),
        (["fly", "forest", "--goal", "300", "0", "2"], "goal (300, 0, 2) lies outside the bounds"),
        (["fly", "forest", "--goal", "1e6", "0", "2"], '"goal" has x = 1e+06; it must be within 100000 m'),
        (["demo", "forest", "--goal", "300", "0", "2"], "goal (300, 0, 2) lies outside the bounds"),
        (["fly", "forest", "--start", "nan", "0", "2"], '"start" has x = nan'),
        (["fly", "forest", "--voxel", "0.2"], "--voxel belongs to a map"),
        (["fly", "map.pcd", "--count", "3"], "--count belongs to a scene"),
        (["fly", "forest", "--port", "9000"], "add --no-headless"),
        (["fly", "forest", "--no-headless", "--json"], "leave out --no-headless"),
    ],
)
def test_mistakes_are_told_in_one_sentence(
    capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    error = run_refused(capsys, *arguments)
    assert message in error and error.count("\n") == 1 and error.startswith("aero-viz: ")


DISTURBED = [
    "--drone.drag", "0.3", "--drone.gust-speed", "1", "--drone.gust-time", "0.5", "--drone.latency", "0.02",
    "--drone.thrust-lag", "0.03", "--drone.rate-lag", "0.02", "--noise.position", "0.03", "--noise.velocity", "0.05",
    "--noise.attitude", "0.5", "--rules.ticks-per-plan", "5", "--lidar.range-max", "20", "--lidar.range-noise", "0.05",
    "--lidar.dropout", "0.1", "--sampling.samples", "16",
]  # fmt: skip


def test_disturbances_reach_the_flight_its_log_and_the_log_changes_nothing(
    capsys: pytest.CaptureFixture[str], poles: str, tmp_path: Path
) -> None:
    """The same flags give `fly` and `fly_and_log` the same disturbed flight, and each flag is in the log."""
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


def test_start_and_goal_of_any_world_are_flags(capsys: pytest.CaptureFixture[str], poles: str, tmp_path: Path) -> None:
    path = tmp_path / "flight.csv"
    ends = ["--start", "0", "-1", "2", "--goal", "8", "1.5", "2"]
    result = run_json(capsys, "fly", poles, *ends, "--sampling.samples", "16", "--trajectory", str(path))
    rows = [[float(row[axis]) for axis in "xyz"] for row in csv.DictReader(path.open())]
    assert result["arrived"] and rows[0] == [0.0, -1.0, 2.0]
    assert np.linalg.norm(np.array(rows[-1]) - [8.0, 1.5, 2.0]) <= 1.0


def test_a_map_of_points_is_flown_at_the_voxel_size_asked_for(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = str(tmp_path / "hall.npy")
    floor = np.stack(np.meshgrid(np.arange(-3, 15, 0.2), np.arange(-4, 4, 0.2), [0.0]), axis=-1).reshape(-1, 3)
    pole = np.stack(np.meshgrid([5.0, 5.2], [0.6, 0.8], np.arange(0, 5, 0.2)), axis=-1).reshape(-1, 3)
    np.save(path, np.vstack([floor, pole]))
    ends = ["--start", "0", "0", "2", "--goal", "10", "0", "2"]
    result = run_json(capsys, "fly", path, *ends, "--voxel", "0.4", "--speed", "4", "--sampling.samples", "16")
    assert result["arrived"] and result["scene"] == "hall"
    capsys.readouterr()
    for voxel in ("0.2", "0.4"):
        main(["world", "export", path, str(tmp_path / "w.json"), *ends, "--voxel", voxel])
        world = json.loads((tmp_path / "w.json").read_text())
        assert world["start"] == [0.0, 0.0, 2.0] and min(box[5] for box in world["boxes"]) == pytest.approx(
            float(voxel)
        )


def in_terminal(*arguments: str, interrupt: str = "") -> tuple[int, str, str]:
    """Run the command line with stderr on a terminal; press Ctrl-C when `interrupt` is seen there."""
    pty = pytest.importorskip("pty", reason="a terminal needs POSIX")
    ours, theirs = pty.openpty()
    command = [sys.executable, "-m", "aero_viz", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=theirs, text=True)
    os.close(theirs)
    shown = ""
    try:
        while True:
            try:
                shown += os.read(ours, 4096).decode(errors="replace")
            except OSError:  # the other side is closed
                break
            if interrupt and interrupt in shown:
                process.send_signal(signal.SIGINT)
                interrupt = ""
        printed, _ = process.communicate(timeout=60)
        return process.returncode, printed, shown
    finally:
        process.kill()
        process.wait()
        os.close(ours)


def test_a_terminal_sees_progress_and_json_readers_do_not(poles: str) -> None:
    code, printed, shown = in_terminal("fly", poles, "--sampling.samples", "16")
    assert code == 0 and "reason           arrived" in printed
    assert "\r\x1b[Kpoles [" in shown and "% of the way" in shown and shown.endswith("\r\x1b[K")
    code, printed, shown = in_terminal("fly", poles, "--sampling.samples", "16", "--json")
    assert (code, shown) == (0, "") and json.loads(printed)["arrived"]


@pytest.mark.parametrize("logged", [False, True])
def test_ctrl_c_reports_what_was_flown_so_far(tmp_path: Path, logged: bool) -> None:
    log = tmp_path / "flight.mcap"
    options = ["--trajectory", str(tmp_path / "t.csv"), *(["--log", str(log)] if logged else [])]
    code, printed, _ = in_terminal("fly", "forest", "--count", "20", *options, interrupt="1.")
    result = dict(line.split(maxsplit=1) for line in printed.splitlines())
    assert code == 130 and result["arrived"] == "False" and "reason" not in result
    assert result["explanation"].startswith("It ends after")
    rows = list(csv.DictReader((tmp_path / "t.csv").open()))
    assert float(rows[-1]["t"]) == pytest.approx(float(result["flight_time_s"]), abs=1e-3)
    if logged:
        info = inspect_recording(log)
        assert info.problems == () and info.poses == len(rows)


def test_a_missing_browser_is_told(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, poles: str, tmp_path: Path
) -> None:
    monkeypatch.setenv("AERO_VIZ_CHROMIUM", str(tmp_path / "none"))
    assert "AERO_VIZ_CHROMIUM" in run_refused(capsys, "snapshot", poles, str(tmp_path / "out.png"))


def test_the_default_forest_is_flown_without_a_collision(capsys: pytest.CaptureFixture[str]) -> None:
    result = run_json(capsys, "fly", "forest")
    assert result["reason"] == "arrived"
    assert result["min_clearance"] > 0.25


def test_a_malformed_world_is_told_precisely(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "bad.json"
    path.write_text(json.dumps({"name": "bad", "start": [0, 0, 2], "goal": [9, 0, 2], "spheres": [[0, 0, 2]]}))
    error = run_refused(capsys, "fly", str(path))
    assert "spheres" in error and "bad.json" in error


def test_inspect_describes_real_recordings(capsys: pytest.CaptureFixture[str], shared_datasets: Path) -> None:
    info = run_json(capsys, "inspect", str(shared_datasets / "hilti_os0_A_mcap"))
    assert info["sweeps"] == 24
    assert info["duration_s"] == pytest.approx(11.5, abs=0.1)
    assert {topic["type"] for topic in info["topics"]} == {"nav_msgs/msg/Odometry", "sensor_msgs/msg/PointCloud2"}


def test_doctor_finds_this_machine_healthy(capsys: pytest.CaptureFixture[str]) -> None:
    report = run_json(capsys, "doctor")
    assert report["healthy"]
    assert any(check["name"] == "device cpu" and "plans in" in check["found"] for check in report["checks"])


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def serve(*arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "aero_viz", *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_demo_serves_until_it_is_told_to_end(poles: str) -> None:
    port = free_port()
    process = serve("demo", poles, "--port", str(port), "--sampling.samples", "16")
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert f"http://127.0.0.1:{port}" in line
        with urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=10) as page:
            assert page.status == 200
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=20)
        assert process.returncode == 0, error
        assert "Traceback" not in error
    finally:
        process.kill()
        process.wait()


def test_no_headless_flies_in_the_page(poles: str, browser: Browser) -> None:
    """A real start, looked at by a real Chromium: time begins when the page is open, and the drone arrives."""
    port = free_port()
    process = serve("fly", poles, "--no-headless", "--port", str(port), "--speed", "5", "--sampling.samples", "16")
    try:
        assert process.stdout is not None
        assert f"http://127.0.0.1:{port}" in process.stdout.readline()
        with browser.new_page() as page:
            page.goto(f"http://127.0.0.1:{port}")
            page.get_by_text("arrived at the goal").first.wait_for(timeout=60_000)
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=20)
        assert process.returncode == 0 and "Traceback" not in error, error
    finally:
        process.kill()
        process.wait()


def test_a_busy_port_is_told(poles: str) -> None:
    with socket.socket() as occupant:
        occupant.bind(("127.0.0.1", 0))
        occupant.listen()
        port = occupant.getsockname()[1]
        process = serve("demo", poles, "--port", str(port))
        _, error = process.communicate(timeout=60)
    assert process.returncode == 2
    assert str(port) in error and "--port" in error and "Traceback" not in error


def test_parameters_lists_every_one(capsys: pytest.CaptureFixture[str]) -> None:
    main(["parameters"])
    table = capsys.readouterr().out
    for info in parameters():
        assert f"| `{info.path}` |" in table


def test_a_reader_that_leaves_early_is_no_error() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    with open(writing, "w") as broken:
        command = [sys.executable, "-m", "aero_viz", "parameters"]
        result = subprocess.run(command, stdout=broken, stderr=subprocess.PIPE, text=True, timeout=120)
    assert result.returncode == 141
    assert result.stderr == ""


def test_help_needs_no_heavy_import() -> None:
    code = "import sys; from aero_viz.cli import main\ntry: main(['--help'])\nexcept SystemExit: pass\n"
    code += "print([m for m in ('viser', 'open3d', 'playwright', 'trimesh') if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=os.environ, check=True)
    assert result.stdout.splitlines()[-1] == "[]"


START = {
    "the script": "from aero_viz.cli import main; sys.exit(main())",
    "the module": "import runpy; runpy.run_module('aero_viz', run_name='__main__')",
}


@pytest.mark.parametrize("start", START.values(), ids=START)
@pytest.mark.parametrize("module", ["warp", "tyro", "aero_viz.cli.page", "viser"])
def test_ctrl_c_while_it_is_still_being_imported_ends_without_a_word(start: str, module: str) -> None:
    done = interrupted_at_import(module, start, "aero-viz", "demo", "--port", "0")
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")
