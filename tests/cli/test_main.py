"""The command line as a whole: mistakes, help, start-up and how it ends."""

import json
import os
import shlex
import subprocess
import sys

import pytest
from command_line import run, run_refused

from aero_viz.cli import main
from aero_viz.cli.commands import COMMANDS
from tests.planner.interruption import interrupted_at_import


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fly", "forrest"], "forest"),
        (["fly", "forest", "--config", "papr"], "paper"),
        (["fly", "forest", "--costs.q-track", "-3"], "costs.q_track is -3"),
        (["fly", "forest", "--device", "cuda:77"], "device 'cuda:77' is not available: this machine has cpu"),
        (["fly", "forest", "--speed", "-1"], "speed_limit"),
        (["fly", "missing.json"], "missing.json"),
        (["fly", "missing.json", "--seed", "-1"], "--seed is -1; it must be in [0, 2^32 - 1]"),
        (["demo", "forest", "--seed", "4294967296"], "--seed is 4294967296; it must be in [0, 2^32 - 1]"),
        (["world", "export", "forest", "a.json", "--seed", "-1"], "--seed is -1; it must be in [0, 2^32 - 1]"),
        (["inspect", "missing.bag"], "missing.bag"),
        (["play", "missing.bag"], "missing.bag"),
        (["play", "world.json"], "aero-viz demo world.json"),
        (["play", "forest"], "forest is a scene, not a recording; fly it with: aero-viz demo forest"),
        (["demo", "--host", "203.0.113.7"], "not an address of this machine; choose another one with --host"),
        (["snapshot", "forest", "/"], "/ is a folder; give the name of a file"),
        (["demo", "forrest"], "forest"),
        (["snapshot", "forrest", "out.png"], "forest"),
        (["nonsense"], "nonsense"),
        (["fly", "forest", "--noise.position", "-1"], "noise.position is -1.0; it must be a number in [0, 100] m"),
        (["fly", "forest", "--drone.drag", "1e3"], "drone.drag is 1000.0"),
        (["fly", "forest", "--drone.gust-speed", "2"], "set drone.drag too"),
        (["fly", "forest", "--lidar.range-max", "0.1"], "lidar.range_min is 0.1; it must be less than lidar.range_max"),
        (["fly", "forest", "--lidar.dropout", "2"], "lidar.dropout is 2.0; it must be a number in [0, 1]"),
        (["fly", "forest", "--rules.ticks-per-plan", "0"], "rules.ticks_per_plan is 0"),
        (["fly", "forest", "--rules.period", "0.2"], "less than the tick"),
        (["fly", "forest", "--lidar", "mid36"], "did you mean 'mid360'"),
        (["demo", "forest", "--noise.attitude", "999"], "noise.attitude is 999.0"),
        (["demo", "forest", "--speed", "99"], "vehicle.speed_limit is 99.0"),
        (["bench", "rooms", "--drone.latency", "-1"], "drone.latency is -1.0"),
        (["fly", "forest", "--start", "-300", "0", "2"], "start (-300, 0, 2) lies outside the bounds"),
        (["fly", "forest", "--goal", "1e6", "0", "2"], '"goal" has x = 1e+06; it must be within 100000 m'),
        (["fly", "forest", "--start", "nan", "0", "2"], '"start" has x = nan'),
        (
            ["fly", "forest", "--voxel", "0.2"],
            "--voxel applies to point-cloud maps and images only, and forest is neither",
        ),
        (["fly", "map.pcd", "--count", "3"], "--count applies to generated scenes only"),
        (["fly", "forest", "--port", "9000"], "--port has no effect here; it is for the page: add --no-headless"),
        (["compare", "a.mcap", "b.mcap", "--open"], "--open has no effect here; it is for the page: add --page"),
        (["compare", "a.mcap", "b.mcap", "--page", "--folder", "."], "--folder has no effect here; the page of a"),
        (["connect", "127.0.0.1", "--folder", "."], "--folder has no effect here; the page of a drone opens no files"),
        (["tune", "wall", "--over", "costs.q_track", "--paused"], "--paused has no effect here; it is for the page"),
        (["fly", "forest", "--no-headless", "--trajectory", "t.csv"], "leave out --no-headless"),
        (["fly", "wall", "--log", "a", "--trajectory", "a"], "a cannot hold two outputs"),
        (["share", "wall", "a.html", "--duration", "0"], "The duration is 0 s; it must be positive"),
        (["share", "wall", "a.html", "--duration", "nan"], "The duration is nan s; it must be positive"),
        (["share", "missing.mcap", "a.html"], "missing.mcap does not exist"),
        (["convert", "a.bag", "b.bag"], "b.bag would hold MCAP; give a name that ends in .mcap, such as b.mcap"),
        (["connect", "127.0.0.1", "--drone-port", "99999"], "127.0.0.1:99999 has no valid port; give one from 1 to"),
        (["world", "info", "wall", "--radius", "-1"], "the radius of the drone is -1 m; it must be positive"),
    ],
)
def test_a_mistake_is_reported_in_one_line(capsys: pytest.CaptureFixture[str], arguments: list[str], message: str):
    error = run_refused(capsys, *arguments)
    assert message in error and error.count("\n") == 1 and error.startswith("aero-viz: ")


@pytest.mark.parametrize(
    ("arguments", "messages"),
    [
        (["fly", "forest", "--sampling.samples", "many"], ["--sampling.samples: 'many' is not a whole number"]),
        (["fly", "forest", "--speed", "abc"], ["--speed: 'abc' is not a number"]),
        (["fly", "forest", "--drone.drg", "1"], ["Unrecognized options: --drone.drg", "meant", "--drone.drag FLOAT"]),
        (["export"], ["Missing", "OUT[.tar]", "aero-viz export --help"]),
    ],
)
def test_a_mistake_in_a_flag_is_reported_in_one_line(
    capsys: pytest.CaptureFixture[str], arguments: list[str], messages: list[str]
):
    error = run_refused(capsys, *arguments)
    assert all(message in error for message in messages) and error.count("\n") == 1, error


def test_the_version_is_printed(capsys: pytest.CaptureFixture[str]):
    code, text, _ = run(capsys, "--version")
    assert code == 0 and text.startswith("aero-viz ") and "aero-planner " in text


def test_the_list_of_commands_quotes_their_docstrings(capsys: pytest.CaptureFixture[str]):
    code, text, _ = run(capsys, "--help")
    assert code == 0
    for name, command in COMMANDS.items():
        function = command.load()
        assert function.__name__ == name.replace(" ", "_")
        assert (function.__doc__ or "").partition("\n")[0] == command.summary
        assert f"  {name}" in text and command.summary in text


HEAVY = {"viser", "open3d", "playwright", "trimesh", "warp"}


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_for_every_flag(capsys: pytest.CaptureFixture[str], command: str):
    code, text, error = run(capsys, *command.split(), "--help")
    assert (code, error) == (0, "") and f"usage: aero-viz {command} " in text
    assert COMMANDS[command].summary in " ".join(text.split())


def test_a_reader_that_closes_the_pipe_early_causes_no_error():
    reading, writing = os.pipe()
    os.close(reading)
    with open(writing, "w") as broken:
        command = [sys.executable, "-m", "aero_viz", "parameters"]
        result = subprocess.run(command, stdout=broken, stderr=subprocess.PIPE, text=True, timeout=120)
    assert result.returncode == 141
    assert result.stderr == ""


@pytest.mark.parametrize(
    ("commands", "heavy"),
    [([""], {"numpy", "tyro", "rich", *HEAVY}), (list(COMMANDS), HEAVY)],
    ids=["of the program", "of every command"],
)
def test_help_imports_no_heavy_library(commands: list[str], heavy: set[str]):
    code = f"import sys; from aero_viz.cli import main\nfor command in {commands}:\n"
    code += "    try: main([*command.split(), '--help'])\n    except SystemExit: pass\n"
    code += "print(*sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=os.environ, check=True)
    assert not heavy & set(result.stdout.splitlines()[-1].split())


def test_completion_scripts_contain_the_flags(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as end:
        main(["--tyro-print-completion", "bash"])
    assert not end.value.code and "--points-topic" in capsys.readouterr().out


START = {
    "the script": "from aero_viz.__main__ import main; sys.exit(main())",
    "the module": "import runpy; runpy.run_module('aero_viz', run_name='__main__')",
}


@pytest.mark.parametrize("start", START.values(), ids=START)
@pytest.mark.parametrize(
    "module", ["aero_viz.cli", "aero_planner.termination", "warp", "tyro", "aero_viz.cli.page", "viser"]
)
def test_ctrl_c_during_start_up_ends_quietly(start: str, module: str):
    done = interrupted_at_import(module, start, "aero-viz", "demo", "--port", "0")
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


def run_with_stdout(target: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the command line with stdout redirected by a shell."""
    command = shlex.join([sys.executable, "-m", "aero_viz", *arguments])
    return subprocess.run(["sh", "-c", f"{command} {target}"], stderr=subprocess.PIPE, text=True, timeout=120)


def test_a_closed_stdout_is_no_error():
    done = run_with_stdout(">&-", "parameters")
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="a device that is always full needs Linux")
def test_a_full_disk_behind_stdout_is_reported_in_one_line():
    done = run_with_stdout("> /dev/full", "parameters")
    assert done.returncode == 2
    assert done.stderr == "aero-viz: the output cannot be written or read: No space left on device.\n"


@pytest.mark.parametrize(
    "arguments",
    [
        ["inspect", "missing.bag"],
        ["fly", "forrest"],
        ["fly", "forest", "--no-headless"],
        ["convert", "missing.bag", "out.mcap"],
        ["explain", "no.mcap"],
    ],
)
def test_json_holds_the_message_of_a_refusal(capsys: pytest.CaptureFixture[str], arguments: list[str]):
    code, text, error = run(capsys, *arguments, "--json")
    assert code == 2 and error.strip() == f"aero-viz: {json.loads(text)['error']}"
