"""`aero-viz tune`."""

import json
import signal
import socket
from pathlib import Path

import pytest
from command_line import run, run_in_terminal, run_json, run_refused

from aero_planner.config.file import load_config
from aero_viz.scenes import scene

SMALL = ["--sampling.samples", "16", "--lidar.points-per-sweep", "1000"]
CRIPPLED = ["--vehicle.speed-limit", "2", "--over", "vehicle.speed_limit=2:8", *SMALL]
FEW = ["--flights", "2", "--rungs", "1", "--trials", "3", "--check", "1", "--storage", "memory"]


def test_the_result_is_printed_written_and_can_be_flown(
    capsys: pytest.CaptureFixture[str], short_poles: str, tmp_path: Path
):
    path = tmp_path / "tuned.yaml"
    code, text, error = run(capsys, "tune", short_poles, *CRIPPLED, *FEW, "--seed", "1", "--output", str(path))
    assert (code, error) == (0, "")
    found = load_config(path)
    assert found.vehicle.speed_limit > 2.0 and found.sampling.samples == 16
    assert f"As flags: --vehicle.speed-limit {found.vehicle.speed_limit:g}\n{path}\n" in text
    assert "incumbent, fresh worlds  1 " in text and "best, fresh worlds       1 " in text
    assert "Warning: the difference is not significant" in text  # of a single flight
    assert run_json(capsys, "fly", short_poles, "--config", str(path), *SMALL)["flight_time_s"] < 4.0

    error = run_refused(capsys, "tune", short_poles, *CRIPPLED, "--output", str(path))
    assert f"{path} exists already; add --overwrite" in error and error.count("\n") == 1


def test_json_is_complete_and_flags_reach_the_flights(
    capsys: pytest.CaptureFixture[str], short_poles: str, tmp_path: Path
):
    path = tmp_path / "tuned.yaml"
    path.write_text("old\n")
    arguments = ["--over", "costs.q-track", *SMALL, *FEW, "--rules.time-limit", "0.1", "--drone.drag", "0.3"]
    code, text, _ = run(
        capsys, "tune", short_poles, *arguments, "--speed", "4", "--json", "--output", str(path), "--overwrite"
    )
    content = json.loads(text)
    assert code == 0 and text.count("\n") == 1
    assert content["over"] == [{"path": "costs.q_track", "low": 0.75, "high": 12.0}]
    assert (content["best"]["trial"], content["check"], content["interrupted"]) == (None, None, False)
    assert [candidate["flights"] for candidate in content["candidates"]] == [2, 2, 2, 2]
    assert content["simulation"]["rules"]["time_limit"] == 0.1 and content["simulation"]["vehicle"]["drag"] == 0.3
    assert content["simulation"]["lidar"]["points_per_sweep"] == 1000
    assert content["config"]["vehicle"]["speed_limit"] == 4.0 and content["config"]["costs"]["use_ground"] is True
    assert load_config(path).to_dict() == content["config"]


def test_each_flight_of_a_scene_has_its_own_world(capsys: pytest.CaptureFixture[str]):
    """The goal lies in an obstacle of the third world only, in which the check is flown."""
    goal = scene("verticals", seed=2, count=100).cylinders[0, :3] + (0.0, 0.0, 2.0)
    assert all(scene("verticals", seed=seed, count=100).distance(goal[None])[0] > 0.0 for seed in (0, 1))
    place = ["--goal", *map(str, goal), "--count", "100", "--rules.time-limit", "0.1", "--over", "costs.q_track"]
    assert "inside an obstacle" in run_refused(capsys, "tune", "verticals", *place, *SMALL, *FEW)


def test_the_same_command_continues_a_study(capsys: pytest.CaptureFixture[str], short_poles: str, tmp_path: Path):
    storage = f"sqlite:///{tmp_path}/tune.db"
    arguments = ["tune", short_poles, "--over", "costs.q-track", *SMALL, *FEW, "--rules.time-limit", "0.1"]
    first, second = (run_json(capsys, *arguments, "--storage", storage, "--trials", trials) for trials in ("3", "5"))
    assert second["study"] == first["study"] and second["candidates"][:4] == first["candidates"]
    assert len(second["candidates"]) == 6


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_and_sigterm_write_the_best_so_far(short_poles: str, tmp_path: Path, number: signal.Signals):
    """A signal during the check, when the search is complete."""
    path = tmp_path / "tuned.yaml"
    few = ["--flights", "1", "--rungs", "1", "--trials", "3", "--check", "50", "--storage", "memory"]
    code, printed, shown = run_in_terminal(
        *("tune", short_poles, *CRIPPLED, *few, "--output", str(path)),
        interrupt_at=lambda shown: "fresh worlds" in shown,
        interrupt_by=number,
    )
    assert code == 130 and "Traceback" not in shown
    assert "Warning: the search was interrupted before the check" in printed and printed.endswith(f"{path}\n")
    assert load_config(path).vehicle.speed_limit > 2.0


def test_sigterm_ends_the_page_of_a_study_after_the_result(short_poles: str, tmp_path: Path):
    path, storage = tmp_path / "tuned.yaml", ["--storage", f"sqlite:///{tmp_path}/tune.db"]
    few = ["--flights", "1", "--rungs", "1", "--trials", "3", "--check", "50"]
    code, printed, shown = run_in_terminal(
        *("tune", short_poles, *CRIPPLED, *few, *storage, "--page", "--port", "0", "--output", str(path)),
        interrupt_at=lambda shown: "fresh worlds" in shown and "AERO-Viz shows" in shown,
        interrupt_by=signal.SIGTERM,
    )
    assert code == 130 and "Traceback" not in shown and printed.endswith(f"{path}\n")
    assert load_config(path).vehicle.speed_limit > 2.0


def test_a_page_that_cannot_be_served_is_reported_in_one_line(short_poles: str, tmp_path: Path):
    few = ["--flights", "1", "--rungs", "1", "--trials", "1", "--check", "1", "--rules.time-limit", "0.1"]
    with socket.socket() as occupant:
        occupant.bind(("127.0.0.1", 0))
        page = ["--storage", f"sqlite:///{tmp_path}/tune.db", "--page", "--port", str(occupant.getsockname()[1])]
        code, printed, shown = run_in_terminal("tune", short_poles, *CRIPPLED, *few, *page)
    assert code == 0 and "No candidate was better" in printed
    assert "is not available" in shown and "The search goes on without the page." in shown and "Traceback" not in shown


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["tune", "forest"], "nothing to tune; name a parameter, such as --over costs.q_track"),
        (["tune", "forest", "--over", "costs.q_trak"], "did you mean 'costs.q_track'?"),
        (["tune", "forest", "--over", "sampling.steps"], "sampling.steps is structural"),
        (["tune", "forrest", "--over", "costs.q_track"], "forest"),
        (["tune", "forest", "--over", "costs.q_track", "--flights", "-1"], "--flights and --check must be at least 1"),
        (
            ["tune", "forest", "--over", "costs.q_track", "--flights", "100001"],
            "--flights is 100001; it must be",
        ),
        (["tune", "forest", "--over", "costs.q_track", "--trials", "100001"], "--trials is 100001; it must be"),
        (["tune", "forest", "--over", "costs.q_track", "--check", "100001"], "--check is 100001; it must be"),
        (["tune", "forest", "--over", "costs.q_track", "--flights", "1"], "give --rungs 1, or more --flights."),
        (["tune", "forest", "--over", "costs.q_track", "--device", "cuda:77"], "this machine has cpu"),
        (["tune", "forest", "--over", "costs.q_track", "--output", "/absent/a.yaml"], "There is no folder /absent;"),
        (["tune", "forest", "--over", "costs.q_track", "--output", "/"], "/ is a folder"),
        (["tune", "forest", "--over", "costs.q_track", "--lidar.dropout", "2"], "lidar.dropout is 2.0"),
        (["tune", "{world}", "--over", "costs.q_track", "--seed", "-1"], "--seed is -1; it must be in [0, 2^32 - 1]"),
        (["tune", "forest", "--over", "costs.q_track", "--storage", "sqlite:////no/a.db"], "There is no folder /no;"),
        (["tune", "{world}", "--over", "costs.q_track", "--storage", "foo"], "foo is no URL of a storage; give"),
    ],
)
def test_mistakes_are_reported_in_one_line(
    capsys: pytest.CaptureFixture[str], short_poles: str, arguments: list[str], message: str
):
    error = run_refused(capsys, *(argument.format(world=short_poles) for argument in arguments))
    assert message in error and error.count("\n") == 1 and error.startswith("aero-viz: ")


def test_help_explains_the_comparison(capsys: pytest.CaptureFixture[str]):
    code, text, _ = run(capsys, "tune", "--help")
    assert code == 0
    assert "by the share of flights that arrive and, where that is equal, by the objective" in " ".join(text.split())
