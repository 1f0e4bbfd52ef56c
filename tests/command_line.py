"""The command line of `aero-viz` in the test's own process."""

from __future__ import annotations

import pytest

from aero_viz.cli import main

__all__ = ["run"]


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    """Return exit code, stdout and stderr of the arguments."""
    capsys.readouterr()  # what fixtures printed
    code = 0
    try:
        main(list(arguments))
    except SystemExit as end:
        code = int(end.code or 0)
    captured = capsys.readouterr()
    return code, captured.out, captured.err
