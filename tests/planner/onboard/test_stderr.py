import os
import subprocess
import sys
from collections.abc import Iterator

import pytest

PATIENCE = 60.0
"""Timeout for a busy machine [s]."""

LOGGING = """
import logging
from aero_planner.onboard.stderr import log_to_stderr

log_to_stderr()
for number in range(3000):
    logging.info("line %d of many that are as long as this one", number)
print("done")
"""


def fill(pipe: int) -> None:
    """Write to a pipe until it is full."""
    os.set_blocking(pipe, False)
    for size in (4096, 1):
        try:
            while True:
                os.write(pipe, b"x" * size)
        except BlockingIOError:
            pass
    os.set_blocking(pipe, True)


@pytest.fixture
def stalled() -> Iterator[int]:
    """Return the writing end of a full pipe that nobody reads."""
    reading, writing = os.pipe()
    fill(writing)
    yield writing
    os.close(reading)
    os.close(writing)


def test_a_full_pipe_delays_no_thread(stalled: int):
    command = [sys.executable, "-c", LOGGING]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=stalled, text=True, timeout=PATIENCE)
    assert (done.returncode, done.stdout) == (0, "done\n")


def test_the_last_lines_are_written_before_the_process_ends():
    done = subprocess.run([sys.executable, "-c", LOGGING], capture_output=True, text=True, timeout=PATIENCE)
    lines = done.stderr.splitlines()
    # If the writer was too slow, the oldest lines are missing.
    assert "INFO    line 2999 of many" in lines[-1] and len(lines) >= 1000


def test_a_closed_standard_error_does_not_end_the_process():
    done = subprocess.run(
        [sys.executable, "-c", f"import os; os.close(2){LOGGING}"], stdout=subprocess.PIPE, text=True, timeout=PATIENCE
    )
    assert (done.returncode, done.stdout) == (0, "done\n")
