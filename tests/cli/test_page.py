"""How a verb that serves the page ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser
from small_source import small_source


@pytest.fixture
def start() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """A function that starts Python with some arguments; what it started is gone after the test."""
    started: list[subprocess.Popen[str]] = []

    def start(*arguments: str) -> subprocess.Popen[str]:
        command = [sys.executable, *arguments]
        started.append(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.communicate()


def line_of(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline()


@pytest.mark.parametrize("first", [signal.SIGINT, signal.SIGTERM])
def test_the_second_ctrl_c_ends_a_program_that_takes_long_to_close(
    start: Callable[..., subprocess.Popen[str]], first: signal.Signals
) -> None:
    code = "import time; from aero_viz.cli.page import told_to_end; told = told_to_end(); print('serving', flush=True)"
    process = start("-c", f"{code}; told.wait(); print('closing', flush=True); time.sleep(60)")
    assert line_of(process) == "serving\n"
    process.send_signal(first)
    assert line_of(process) == "closing\n"
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=20) == -signal.SIGINT


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="named pipes need POSIX")
def test_ctrl_c_does_not_wait_for_what_the_page_is_opening(
    start: Callable[..., subprocess.Popen[str]], browser: Browser, tmp_path: Path
) -> None:
    world = small_source().scenery.world
    assert world is not None
    world.save(tmp_path / "poles.json")
    os.mkfifo(tmp_path / "slow.json")  # nobody ever writes to it: reading it takes for ever
    process = start("-m", "aero_viz", "demo", str(tmp_path / "poles.json"), "--port", "0", "--paused")
    url = line_of(process).split(" at ")[1].split()[0]
    with browser.new_page() as page:
        page.goto(url)
        row = page.locator("label", has_text="Path").locator("xpath=ancestor::div[contains(@class, 'Flex')][1]")
        row.locator("input").fill(str(tmp_path / "slow.json"))
        page.get_by_role("button", name="Open path", exact=True).click()
        page.get_by_text(f"Opening {tmp_path / 'slow.json'}").first.wait_for(timeout=20_000)
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=20)
    assert process.returncode == 0 and "Traceback" not in error, error
