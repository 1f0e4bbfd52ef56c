"""The commands that serve the page, as processes. `aero-viz connect` is tested with the telemetry client."""

import signal
import socket
import urllib.request

import pytest
from command_line import run_refused

from tests.cli.programs import StartPython, interrupt, read_line


@pytest.mark.parametrize("first", [signal.SIGINT, signal.SIGTERM])
def test_a_second_ctrl_c_ends_a_program_that_takes_long_to_close(start_python: StartPython, first: signal.Signals):
    process = start_python(
        "-c",
        "import time; from aero_viz.cli.serving import shutdown_event, wait_for; event = shutdown_event()\n"
        "print('serving', flush=True); wait_for(event); print('closing', flush=True); time.sleep(600)",
    )
    assert read_line(process) == "serving\n"
    process.send_signal(first)
    assert read_line(process) == "closing\n"
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=60) == -signal.SIGINT


def test_demo_serves_the_page_until_ctrl_c(start_python: StartPython, poles: str):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    process = start_python("-m", "aero_viz", "demo", poles, "--port", str(port), "--sampling.samples", "16")
    assert f"http://127.0.0.1:{port}" in read_line(process)
    with urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=60) as page:
        assert page.status == 200
    interrupt(process)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["verticals"], "--tour has its own scenes; leave out the scene"),
        (["--paused"], "--tour always plays"),
        (["--folder", "."], "opens no files; leave out --paused and --folder"),
    ],
)
def test_a_tour_refuses_what_it_does_not_obey(capsys: pytest.CaptureFixture[str], flags: list[str], message: str):
    assert message in run_refused(capsys, "demo", "--tour", *flags)


def test_a_busy_port_is_reported(start_python: StartPython, poles: str):
    with socket.socket() as occupant:
        occupant.bind(("127.0.0.1", 0))
        occupant.listen()
        port = occupant.getsockname()[1]
        process = start_python("-m", "aero_viz", "demo", poles, "--port", str(port))
        _, error = process.communicate(timeout=60)
    assert process.returncode == 2
    assert str(port) in error and "--port" in error and "Traceback" not in error
