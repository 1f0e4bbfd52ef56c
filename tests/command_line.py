"""Runs the command line of `aero-viz` in the test's own process."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import pytest

from aero_viz.cli import main


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    """Return exit code, stdout and stderr of the command line with these arguments."""
    capsys.readouterr()  # discard the output of fixtures
    code = 0
    try:
        main(list(arguments))
    except SystemExit as end:
        code = int(end.code or 0)
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def run_json(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    """Return the JSON object that a command prints; the command must succeed."""
    code, text, error = run(capsys, *arguments, "--json")
    assert code == 0, error
    return json.loads(text)


def run_refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Return what stderr says about a mistake in the arguments; the exit code must be 2 and stdout empty."""
    code, text, error = run(capsys, *arguments)
    assert (code, text) == (2, "")
    assert "Traceback" not in error
    return error


def terminal_text(box: str) -> str:
    """Return the text of a box that tyro draws, without borders and line breaks."""
    return " ".join(box.translate(dict.fromkeys(map(ord, "╭╮╰╯│─"), " ")).split())


def run_in_terminal(
    *arguments: str,
    interrupt_at: Callable[[str], bool] = lambda shown: False,
    interrupt_by: signal.Signals = signal.SIGINT,
    columns: int = 150,
) -> tuple[int, str, str]:
    """Run the command line in a process whose stderr is a terminal.

    Args:
        arguments: arguments of `aero-viz`.
        interrupt_at: called with everything shown on the terminal so far; Ctrl-C is pressed once when it is true.
        interrupt_by: signal that is sent instead of that of Ctrl-C.
        columns: width of the terminal.

    Returns:
        Exit code, text on stdout, and everything shown on the terminal.
    """
    pty = pytest.importorskip("pty", reason="a terminal needs POSIX")
    controller, terminal = pty.openpty()
    command = [sys.executable, "-m", "aero_viz", *arguments]
    environment = os.environ | {"COLUMNS": str(columns), "TERM": "xterm"}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=terminal, text=True, env=environment)
    os.close(terminal)
    shown, is_interrupted = "", False
    try:
        while True:
            try:
                shown += os.read(controller, 4096).decode(errors="replace")
            except OSError:  # the process has closed its side
                break
            if not is_interrupted and interrupt_at(shown):
                process.send_signal(interrupt_by)
                is_interrupted = True
        printed, _ = process.communicate(timeout=60)
        return process.returncode, printed, shown
    finally:
        process.kill()
        process.wait()
        os.close(controller)
