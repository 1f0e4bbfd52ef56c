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
from small_source import small_source

from aero_planner.config import parameters
from aero_viz.cli import main

FLIGHT_FIELDS = {
    "arrived", "reason", "flight_time_s", "mean_speed", "max_speed", "smoothness", "length_m", "mean_clearance",
    "min_clearance", "plan_ms_median", "seed", "scene", "config",
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
    assert run_json(capsys, "fly", str(path))["reason"] == "collision"


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
        (["demo", "forrest"], "forest"),
        (["snapshot", "forrest", "out.png"], "forest"),
        (["nonsense"], "nonsense"),
    ],
)
def test_mistakes_are_told_without_a_traceback(
    capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert message in run_refused(capsys, *arguments)


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
    command = [sys.executable, "-m", "aero_viz.cli", *arguments]
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
        command = [sys.executable, "-m", "aero_viz.cli", "parameters"]
        result = subprocess.run(command, stdout=broken, stderr=subprocess.PIPE, text=True, timeout=120)
    assert result.returncode == 141
    assert result.stderr == ""


def test_help_needs_no_heavy_import() -> None:
    code = "import sys; from aero_viz.cli import main\ntry: main(['--help'])\nexcept SystemExit: pass\n"
    code += "print([m for m in ('viser', 'open3d', 'playwright', 'trimesh') if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=os.environ, check=True)
    assert result.stdout.splitlines()[-1] == "[]"
