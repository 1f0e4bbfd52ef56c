"""How `aero-planner` ends."""

from __future__ import annotations

import subprocess
import sys

import pytest

START = {
    "the script": "from aero_planner.cli import main; sys.exit(main())",
    "the module": "import runpy; runpy.run_module('aero_planner', run_name='__main__')",
}
CTRL_C = """
import os, signal, sys

class Interruption:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interruption())
sys.argv = ["aero-planner", *{call!r}.split()]
{start}
"""


@pytest.mark.parametrize("start", START.values(), ids=START)
@pytest.mark.parametrize(
    ("call", "module"),
    [
        ("config show", "importlib.metadata"),
        ("config show", "aero_planner.config_file"),
        ("run", "numpy"),
        ("preflight", "warp"),
    ],
)
def test_ctrl_c_while_it_is_still_being_imported_ends_without_a_word(start: str, call: str, module: str):
    code = CTRL_C.format(call=call, module=module, start=start)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")
