"""SIGTERM: a program ends as after Ctrl-C and leaves nothing behind."""

import contextlib
import os
import signal
import subprocess
import sys
import uuid
from pathlib import Path

import pytest

from aero_planner import PlannerConfig
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.telemetry import Telemetry
from tests.dashboard.page_client import wait_for


def processes_with(tag: str) -> list[Path]:
    """Return the processes that have inherited `tag`."""
    found = []
    for environment in Path("/proc").glob("[0-9]*/environ"):
        with contextlib.suppress(OSError):  # it has ended, or is another user's
            found += [environment] * (tag in environment.read_text(errors="replace"))
    return found


@pytest.mark.parametrize(
    ("program", "arguments", "line", "code"),
    [
        ("aero_viz", ("demo", "{world}", "--port", "0", "--sampling.samples", "16"), " at http", 0),
        ("aero_viz", ("play", "--port", "0", "--sampling.samples", "16"), "forest_mid360.mcap at http", 0),
        ("aero_viz", ("connect", "127.0.0.1", "--drone-port", "{port}", "--port", "0"), " at http", 0),
        ("aero_planner", ("rig", "{world}"), "node started", 130),
    ],
)
def test_sigterm_leaves_nothing_behind(program, arguments, line, code, short_poles: str, tmp_path: Path):
    tag = uuid.uuid4().hex
    telemetry = Telemetry(PlannerConfig(), OnboardConfig().replace({"telemetry.port": 0}))
    words = [word.format(world=short_poles, port=telemetry.port) for word in arguments]
    environment = {**os.environ, "TMPDIR": str(tmp_path), "AERO_TEST_TAG": tag}
    command = [sys.executable, "-m", program, *words]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as process:
        assert process.stdout is not None
        assert line in process.stdout.readline()
        process.send_signal(signal.SIGTERM)
        try:
            _, error = process.communicate(timeout=120.0)
        finally:
            process.kill()
    telemetry.close()
    assert process.returncode == code and "Traceback" not in error, error
    # The node's failsafe process outlives it for a moment: it makes sure that the node has ended.
    wait_for(lambda: processes_with(tag) == [], "all processes to end")
    assert os.listdir(tmp_path) == []
