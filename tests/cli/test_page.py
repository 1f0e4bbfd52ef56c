"""The commands that serve the page, as processes. `aero-viz connect` is tested with the telemetry client."""

import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from command_line import run_refused
from playwright.sync_api import Browser
from small_source import small_config

from aero_viz.flight import fly
from aero_viz.logs import flight_recorder
from aero_viz.scenes import World
from tests.browser.desk import COARSE, visit

StartPython = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def start_python() -> Iterator[StartPython]:
    """A function that starts a Python process. All processes are killed after the test."""
    started: list[subprocess.Popen[str]] = []

    def start(*arguments: str) -> subprocess.Popen[str]:
        command = [sys.executable, *arguments]
        started.append(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.communicate()


def read_line(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline()


def read_url(process: subprocess.Popen[str]) -> str:
    """Return the address that the process prints when it serves the page."""
    return read_line(process).split(" at ")[1].split()[0]


def interrupt(process: subprocess.Popen[str]) -> None:
    """Press Ctrl-C; the process must end by itself, without an error."""
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 0 and "Traceback" not in error, error


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


def test_ctrl_c_does_not_wait_for_a_source_that_is_being_opened(
    start_python: StartPython, browser: Browser, poles: str, tmp_path: Path
):
    slow = tmp_path / "slow.json"
    slow.write_text("[" + "[0, 0, 0]," * 5_000_000 + "0]")  # 50 MB
    process = start_python("-m", "aero_viz", "demo", poles, "--port", "0", "--paused", "--folder", str(tmp_path))
    url = read_url(process)
    with visit(browser, url, resolution=COARSE) as page:
        row = page.locator("label", has_text="Path").locator("xpath=ancestor::div[contains(@class, 'Flex')][1]")
        row.locator("input").fill(str(slow))
        page.get_by_role("button", name="Open path", exact=True).click()
        page.get_by_text(f"Opening {slow}").first.wait_for(timeout=90_000)
        interrupt(process)


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


def test_no_headless_flies_in_the_page(start_python: StartPython, short_poles: str, browser: Browser):
    """Playback starts when the page is open in a real Chromium, and the drone arrives."""
    options = ["--no-headless", "--port", "0", "--speed", "5", "--sampling.samples", "16"]
    process = start_python("-m", "aero_viz", "fly", short_poles, *options)
    url = read_url(process)
    with visit(browser, url, resolution=COARSE) as page:
        page.get_by_text("arrived at the goal").first.wait_for(timeout=180_000)
    interrupt(process)


def test_two_logs_are_compared_in_the_terminal_and_on_one_page(
    start_python: StartPython, short_poles: str, browser: Browser, tmp_path: Path
):
    a, b = str(tmp_path / "a.mcap"), str(tmp_path / "b.mcap")
    for path, speed in ((a, 2.0), (b, 3.0)):
        fly(World.load(short_poles), config=small_config(), speed=speed, recorder=flight_recorder(path))
    process = start_python("-m", "aero_viz", "compare", a, b, "--page", "--port", "0")
    printed = ""
    while " at http" not in (line := read_line(process)):
        assert process.poll() is None
        printed += line
    assert "vehicle.speed_limit" in printed and f"{b} with the ghost of {a}" in line
    with visit(browser, line.split(" at ")[-1].split()[0], resolution=COARSE) as page:
        page.get_by_role("tab", name="Curves").click()
        page.locator(".aero-ghost").first.wait_for(state="attached")
        page.locator(".aero-differs").first.wait_for(state="attached")
    interrupt(process)


def test_a_busy_port_is_reported(start_python: StartPython, poles: str):
    with socket.socket() as occupant:
        occupant.bind(("127.0.0.1", 0))
        occupant.listen()
        port = occupant.getsockname()[1]
        process = start_python("-m", "aero_viz", "demo", poles, "--port", str(port))
        _, error = process.communicate(timeout=60)
    assert process.returncode == 2
    assert str(port) in error and "--port" in error and "Traceback" not in error
