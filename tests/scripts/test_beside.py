"""Targets of the Makefile beside a command."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "scripts" / "beside.py"
MAKEFILE = """
slow:
\t@echo begin; sleep 0.3; nice; echo end
session:
\t@cat /proc/self/autogroup
wrong:
\t@echo broken; false
held:
\t@touch started; sleep 2; echo end
endless:
\t@touch started; sleep 60; touch ended
"""


@pytest.fixture
def script(tmp_path: Path) -> Path:
    """The script in a project of its own, whose Makefile has quick targets."""
    (tmp_path / "scripts").mkdir()
    (tmp_path / "Makefile").write_text(MAKEFILE)
    (tmp_path / "scripts" / "beside.py").write_text(SCRIPT.read_text())
    return tmp_path / "scripts" / "beside.py"


def run(script: Path, targets: str, command: str) -> subprocess.CompletedProcess[str]:
    program = [sys.executable, script, targets, "sh", "-c", command]
    return subprocess.run(program, cwd=script.parents[1], capture_output=True, text=True)


def test_the_target_runs_at_low_priority_and_its_output_stays_together(script: Path):
    done = run(script, "slow", "echo command >&2; sleep 0.1")
    assert done.returncode == 0
    assert done.stdout == "begin\n19\nend\n" and done.stderr == "command\n"


def test_the_session_of_the_target_has_low_priority_where_linux_weighs_sessions(script: Path):
    if Path("/proc/self/autogroup").exists():
        # Linux lets unprivileged users change ten weights per second, all together.
        assert any(run(script, "session", "true").stdout.endswith("nice 19\n") for _ in range(20))


def test_the_exit_code_is_that_of_the_command_or_of_the_target(script: Path):
    assert run(script, "slow", "exit 3").returncode == 3
    failed = run(script, "wrong", "true")
    assert failed.returncode == 2 and "broken" in failed.stdout
    assert run(script, "wrong", "exit 3").returncode == 3


def test_targets_run_one_after_another_even_if_one_fails(script: Path):
    done = run(script, "wrong,slow", "true")
    assert done.returncode == 2 and "broken" in done.stdout and done.stdout.endswith("begin\n19\nend\n")


def test_no_target_is_started_after_the_command_has_failed(script: Path):
    done = run(script, "held,wrong", "until [ -e started ]; do sleep 0.02; done; exit 3")
    assert done.returncode == 3 and done.stdout == "end\n"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_both_end_with_an_interruption(script: Path, number: int):
    with subprocess.Popen([sys.executable, script, "endless", "sleep", "60"], stderr=subprocess.DEVNULL) as process:
        deadline = time.monotonic() + 30.0
        while not (script.parents[1] / "started").exists():
            assert time.monotonic() < deadline
            time.sleep(0.02)
        process.send_signal(number)
        assert process.wait(30.0) != 0
    assert not (script.parents[1] / "ended").exists()
