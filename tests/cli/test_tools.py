"""`aero-viz inspect`, `snapshot`, `export`, `parameters` and `doctor`. The benchmarks test `aero-viz world`."""

from pathlib import Path

import pytest
from command_line import run, run_json, run_refused

from aero_planner.config import PlannerConfig


def test_inspect_describes_real_recordings(capsys: pytest.CaptureFixture[str], shared_datasets: Path):
    info = run_json(capsys, "inspect", str(shared_datasets / "hilti_os0_A_mcap"))
    assert info["sweeps"] == 24
    assert info["duration_s"] == pytest.approx(11.5, abs=0.1)
    assert {topic["type"] for topic in info["topics"]} == {"nav_msgs/msg/Odometry", "sensor_msgs/msg/PointCloud2"}


def test_a_missing_browser_is_reported(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, poles: str, tmp_path: Path
):
    monkeypatch.setenv("AERO_VIZ_CHROMIUM", str(tmp_path / "none"))
    assert "AERO_VIZ_CHROMIUM" in run_refused(capsys, "snapshot", poles, str(tmp_path / "out.png"))


def test_a_picture_is_planned_as_its_flight_would_be(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    taken: list[PlannerConfig] = []
    monkeypatch.setattr("aero_viz.dashboard.snapshot.snapshot", lambda _, *, config, **options: taken.append(config))
    run(capsys, "snapshot", "wall", str(tmp_path / "wall.png"))
    assert [config.costs.height_max for config in taken] == [2.5]


def test_doctor_finds_this_machine_healthy(capsys: pytest.CaptureFixture[str]):
    report = run_json(capsys, "doctor")
    assert report["passed"]
    assert any(check["name"] == "device cpu" and "plans in" in check["finding"] for check in report["checks"])


def test_the_table_contains_every_parameter(capsys: pytest.CaptureFixture[str]):
    _, table, _ = run(capsys, "parameters")
    for info in PlannerConfig.parameters():
        assert f"| `{info.path}` |" in table


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{free}"], "give --arch, such as --arch sm_87"),
        (["{free}", "--arch", "sm_87", "--arch", "orin"], "the architecture 'orin' is not understood"),
        (["{free}", "--cpu", "--config", "papr"], "did you mean 'paper'?"),
        (["{taken}", "--cpu"], "exists already"),
    ],
)
def test_mistakes_in_an_export_are_reported_in_one_line(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, arguments: list[str], message: str
):
    (tmp_path / "taken").write_text("")
    paths = {name: str(tmp_path / name) for name in ("free", "taken")}
    error = run_refused(capsys, "export", *(argument.format(**paths) for argument in arguments))
    assert message in error and error.count("\n") == 1 and error.startswith("aero-viz: ")
    assert not (tmp_path / "free").exists()


def test_the_help_of_export_refers_to_the_planners_own_command(capsys: pytest.CaptureFixture[str]):
    code, text, _ = run(capsys, "export", "--help")
    assert code == 0 and "the same as `aero-planner export`" in " ".join(text.split()) and "--arch" in text
