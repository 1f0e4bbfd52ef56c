"""Python programs that serve something until they are interrupted. The fixture `start_python` starts them."""

import signal
import subprocess
from collections.abc import Callable

StartPython = Callable[..., subprocess.Popen[str]]


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
