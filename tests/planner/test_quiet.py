from __future__ import annotations

import subprocess
import sys

import pytest

COMMAND = """
import sys
import warp as wp
{level}
from aero_planner.quiet import start_warp

start_warp()
print("the result")

@wp.kernel
def fill(values: wp.array(dtype=float)):
    values[wp.tid()] = 1.0

wp.launch(fill, dim=3, outputs=[wp.zeros(3, device="cpu")], device="cpu")
print("a warning", file=sys.stderr)
"""


def said(folder, *, level: str = "") -> tuple[str, str]:
    """What a program writes to stdout and stderr that starts Warp and loads a module."""
    (folder / "command.py").write_text(COMMAND.format(level=level))
    done = subprocess.run([sys.executable, str(folder / "command.py")], capture_output=True, text=True, check=True)
    return done.stdout, done.stderr


def test_stdout_belongs_to_the_results(tmp_path):
    assert said(tmp_path) == ("the result\n", "a warning\n")


@pytest.mark.parametrize("level", ["LOG_DEBUG", "LOG_ERROR"])
def test_who_chose_another_level_keeps_it(tmp_path, level):
    chosen = said(tmp_path, level=f"wp.config.log_level = wp.{level}")[0]
    assert ("Module" in chosen) == (level == "LOG_DEBUG")
