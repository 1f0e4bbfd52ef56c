import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.reader import make_reader

from aero_planner import Planner, PlannerConfig
from aero_planner.cli import main
from aero_planner.onboard.flight_config import load_flight_config
from aero_planner.onboard.known_drone import config_on_drone
from aero_planner.onboard.settings import OnboardConfig
from tests.planner.onboard.test_stderr import fill

Outcome = tuple[int, str, str]


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str]) -> Callable[..., Outcome]:
    """Function that runs the command line in this process and returns exit code, stdout and stderr."""

    def run(*arguments: str) -> Outcome:
        try:
            code = main(arguments)
        except SystemExit as end:  # from argparse
            code = int(end.code or 0)
        output = capsys.readouterr()
        return code, output.out, output.err

    return run


@pytest.fixture
def flight_file(tmp_path: Path) -> Path:
    """Configuration with free ports and a fast planner."""
    path = tmp_path / "flight.yaml"
    path.write_text(
        "sampling:\n  samples: 4\nonboard:\n  lidar:\n    host: 127.0.0.1\n"
        "    port: 0\n    points_max: 2000\n  mavlink:\n    url: 'udpin:127.0.0.1:0'\n"
        "  telemetry:\n    port: 0\n"
    )
    return path


def test_import_is_light_and_leaves_cuda_alone():
    script = (
        "import sys, aero_planner, aero_planner.cli, warp\n"
        "context = sys.modules.get('warp._src.context') or warp.context\n"
        "assert context.runtime is None, 'Warp was initialised, which looks for GPUs'\n"
        "print(sorted(name for name in ('pymavlink', 'mcap', 'yaml', 'aero_viz', 'concurrent.futures.process', "
        "'aero_planner.onboard.node') if name in sys.modules))\n"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert result.stdout == "[]\n" and result.stderr == ""


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["run", "--foo"], "unrecognized arguments: --foo; see aero-planner --help."),
        (["export"], "the following arguments are required: OUT[.tar]; see aero-planner export --help."),
        (["run", "--threads", "x"], "argument --threads: invalid int value: 'x'; see aero-planner run --help."),
    ],
)
def test_wrong_arguments_are_reported_in_one_sentence(call: Callable[..., Outcome], words: list[str], problem: str):
    assert call(*words) == (2, "", f"aero-planner: {problem}\n")


def test_help_lists_the_commands(call: Callable[..., Outcome]):
    code, out, _ = call("--help")
    assert code == 0 and all(command in out for command in ("run", "preflight", "config"))
    code, out, _ = call("run", "--help")
    assert code == 0 and "Never arms and never changes the mode" in " ".join(out.split())
    code, out, _ = call("--version")
    assert code == 0 and re.fullmatch(r"aero-planner \S+\n", out)
    code, out, _ = call()
    assert code == 2 and "usage" in out


def test_the_module_runs_the_command_line(flight_file: Path):
    command = [sys.executable, "-m", "aero_planner", "config", "validate", str(flight_file)]
    result = subprocess.run(command, capture_output=True, text=True)
    assert (result.returncode, result.stdout) == (0, f"{flight_file} is valid\n")


def test_the_output_of_config_show_is_a_valid_file(call: Callable[..., Outcome], tmp_path: Path, flight_file: Path):
    for arguments in (("--config", "paper"), ("--config", str(flight_file)), ()):
        code, out, _ = call("config", "show", *arguments)
        assert code == 0
        path = tmp_path / "shown.yaml"
        path.write_text(out)
        planner, onboard = load_flight_config(path)
        if "paper" in arguments:
            assert (planner, onboard) == (PlannerConfig.preset("paper"), OnboardConfig())
        elif arguments:
            assert planner.sampling.samples == 4 and onboard.telemetry.port == 0


def test_settings_may_come_from_a_separate_file(call: Callable[..., Outcome], tmp_path: Path, flight_file: Path):
    own = tmp_path / "node.yaml"
    own.write_text("rates:\n  replan: 33\n")
    _, out, _ = call("config", "show", "--config", str(flight_file), "--onboard", str(own))
    assert "replan: 33.0" in out and "samples: 4" in out
    assert call("config", "validate", str(own))[0] == 0
    assert call("config", "validate", "px4")[:2] == (0, "px4 is valid\n")


OTHER_MODEL = "vehicle.model is acceleration; the node commands thrust and body rates, so it must be ctbr."


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (["rnu"], "there is no command 'rnu' (did you mean 'run'?)"),
        (["run", "--config", "papr"], "'papr' is neither a preset (did you mean 'paper'?) nor a file"),
        (["run", "--config", "{bad}"], "bad.yaml, line 3: limits.plan_age is 9; it must be a number in [0.05, 2] s."),
        (["preflight", "--config", "{bad}"], "bad.yaml, line 3"),
        (["preflight", "--listen", "0"], "--listen is 0; it must be in [0.1, 600] s."),
        (["config", "validate", "{absent}"], "absent.yaml can't be read: No such file"),
        (["run", "--config", "{other}"], OTHER_MODEL),
        (["preflight", "--config", "{other}"], OTHER_MODEL),
        (["config", "validate", "{other}"], f"other.yaml, line 2: {OTHER_MODEL}"),
        (["export", "{absent}", "--cpu", "--config", "{other}"], OTHER_MODEL),
        (["config", "validate", "{unfit}"], "it must be less than the planner's horizon"),
        (["run", "--onboard", "{absent}"], "absent.yaml can't be read"),
        (["run", "--config", "{flight}", "--device", "cuda:9"], "device 'cuda:9' is not available"),
        (["run", "--config", "{flight}", "--threads", "0"], "threads is 0"),
        (["run", "--config", "{flight}", "--goal", "1", "nan", "2"], "the goal is [1.0, nan, 2.0]"),
        (["run", "--config", "{flight}", "--log", "{absent}/a.mcap"], "can't be written: No such file"),
        (["run", "--config", "{taken}"], "the LiDAR's UDP port 127.0.0.1:"),
        (["run", "--config", "{serial}"], "can't open the connection to the autopilot, /dev/absent (mavlink.url)"),
    ],
)
def test_mistakes_are_one_line_and_exit_code_2(
    call: Callable[..., Outcome], tmp_path: Path, flight_file: Path, arguments: list[str], problem: str
):
    (tmp_path / "bad.yaml").write_text("onboard:\n  limits:\n    plan_age: 9\n")
    (tmp_path / "other.yaml").write_text("vehicle:\n  model: acceleration\n")
    (tmp_path / "unfit.yaml").write_text("sampling:\n  steps: 4\n")
    (tmp_path / "serial.yaml").write_text("onboard:\n  mavlink:\n    url: /dev/absent\n")
    names = {name: tmp_path / f"{name}.yaml" for name in ("bad", "absent", "other", "unfit", "serial", "taken")}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        own = f"    port: {taken.getsockname()[1]}\n"
        names["taken"].write_text(flight_file.read_text().replace("    port: 0\n", own, 1))
        code, _, err = call(*(part.format(flight=flight_file, **names) for part in arguments))
    lines = [line for line in err.splitlines() if line.startswith("aero-planner: ")]
    assert code == 2 and len(lines) == 1 and problem in lines[0] and "Traceback" not in err


def test_preflight_prints_a_table_or_json(call: Callable[..., Outcome], flight_file: Path):
    code, out, _ = call("preflight", "--config", str(flight_file), "--listen", "0.1")
    assert code == 2 and "FAIL  vehicle state" in out and "NOT ready to fly" in out
    code, out, _ = call("preflight", "--config", str(flight_file), "--listen", "0.1", "--json")
    content = json.loads(out)
    assert code == 2 and content["passed"] is False
    assert {check["name"] for check in content["checks"] if not check["ok"]} >= {"vehicle state", "LiDAR"}


@pytest.mark.parametrize("command", [["run"], ["preflight", "--listen", "0.1"]], ids=["run", "preflight"])
def test_a_device_without_memory_is_reported(
    call: Callable[..., Outcome], flight_file: Path, monkeypatch: pytest.MonkeyPatch, command: list[str]
):
    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("Failed to allocate 2147483648 bytes on device 'cuda:0'")

    monkeypatch.setattr("aero_planner.structure.allocate", fail)
    code, out, err = call(*command, "--config", str(flight_file))
    assert code == 2 and "plan" in out + err and "Failed to allocate 2147483648 bytes" in out + err
    assert command == ["run"] or "NOT ready to fly" in out


@pytest.fixture
def other_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Installed package that adds commands."""
    (tmp_path / "other_commands.py").write_text(
        "def swim(arguments):\n    print('swims', *arguments)\n    return 7\n\n\ndef rest(arguments):\n    pass\n"
    )
    folder = tmp_path / "other_commands-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: other-commands\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text(
        "[aero_planner.commands]\nswim = other_commands:swim\nrest = other_commands:rest\nbroken = absent_module:main\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))


def test_other_packages_add_commands(call: Callable[..., Outcome], other_package: None):
    assert call("swim", "--far", "3") == (7, "swims --far 3\n", "")
    assert call("rest")[0] == 0
    code, _, err = call("broken")
    assert code == 2 and err.startswith("aero-planner: No module named 'absent_module'")
    assert "swim" in call("--help")[1] and "(did you mean 'swim'?)" in call("swmi")[2]


def test_a_node_starts_waits_and_ends(flight_file: Path, tmp_path: Path):
    command = [sys.executable, "-m", "aero_planner", "run", "--config", str(flight_file), "--goal", "5", "0", "2"]
    command += ["--log", str(tmp_path), "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None and process.stdout is not None
        lines = []
        for line in process.stderr:
            lines.append(line)
            if "waiting for states, points and a goal" in line:
                process.send_signal(signal.SIGTERM)
        statistics = json.loads(process.stdout.read())
        assert process.wait(60.0) == 0
    text = "".join(lines)
    assert "viewers may connect to 127.0.0.1:" in text and "silent: the autopilot has the drone" in text
    assert statistics["state"] == "WAITING" and statistics["commands_sent"] == 0
    logs = [name for name in os.listdir(tmp_path) if name.startswith("flight_") and name.endswith(".mcap")]
    assert len(logs) == 1 and (tmp_path / logs[0]).stat().st_size > 1000
    with (tmp_path / logs[0]).open("rb") as file:
        flown = {item.name: item.data.decode() for item in make_reader(file).iter_attachments()}["config_0.yaml"]
    (tmp_path / "flown.yaml").write_text(flown)
    assert load_flight_config(tmp_path / "flown.yaml")[0] == config_on_drone(*load_flight_config(flight_file))


def test_the_node_avoids_the_ground_even_where_the_configuration_does_not(
    call: Callable[..., Outcome], flight_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
):  # fmt: skip
    def end(planner: Planner, *_: object, **__: object) -> None:
        raise ValueError(f"the planner avoids the ground: {planner.config.costs.use_ground}")

    monkeypatch.setattr("aero_planner.onboard.run.Node", end)
    flight_file.write_text(flight_file.read_text() + "costs:\n  use_ground: false\n")
    log = tmp_path / "flight.mcap"
    code, _, err = call("run", "--config", str(flight_file), "--log", str(log))
    assert code == 2 and "the planner avoids the ground: True" in err
    assert "costs.use_ground is off; the node switches it on" in caplog.text
    with log.open("rb") as file:
        flown = {item.name: item.data.decode() for item in make_reader(file).iter_attachments()}["config_0.yaml"]
    (tmp_path / "flown.yaml").write_text(flown)
    assert load_flight_config(tmp_path / "flown.yaml")[0].costs.use_ground


def test_a_stalled_and_lost_terminal_does_not_prevent_the_end(flight_file: Path):
    reading, writing = os.pipe()
    command = [sys.executable, "-m", "aero_planner", "run", "--config", str(flight_file), "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=writing, text=True) as process:
        try:
            with os.fdopen(reading, closefd=False) as lines:
                assert any("waiting for states, points and a goal" in line for line in lines)
            fill(writing)
            process.send_signal(signal.SIGHUP)
            output, _ = process.communicate(timeout=60.0)
        finally:
            process.kill()
            os.close(reading)
            os.close(writing)
    assert process.returncode == 0 and json.loads(output)["state"] == "WAITING"


HANGING = """
import sys, threading
from concurrent.futures import ThreadPoolExecutor

from aero_planner import cli, pipeline
from aero_planner.onboard import run as node_program
from tests.planner.onboard.test_node_life import StandingLidar, StandingLink

node_program.open_link = lambda *_: StandingLink()
node_program.open_lidar = lambda *_: StandingLidar()
plan = pipeline.Pipeline.run

def run(self, stages):
    if threading.current_thread().name == "aero-planner-planning":
        print("a plan hangs", file=sys.stderr, flush=True)
        ThreadPoolExecutor(1).submit(threading.Event().wait).result()
    plan(self, stages)

pipeline.Pipeline.run = run
sys.exit(cli.main(["run", "--config", sys.argv[1], "--threads", "2", "--json"]))
"""


def test_a_hanging_plan_does_not_prevent_the_end(flight_file: Path):
    command = [sys.executable, "-c", HANGING, str(flight_file)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None and any("a plan hangs" in line for line in process.stderr)
        process.send_signal(signal.SIGTERM)
        try:
            output, _ = process.communicate(timeout=60.0)
        finally:
            process.kill()
    assert process.returncode == 0 and json.loads(output)["state"] == "WAITING"
