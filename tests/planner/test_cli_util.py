"""Ctrl-C during the start of `aero-planner` and of other programs."""

import gc

import pytest

from aero_planner.cli_util import quick_imports
from tests.planner.interruption import interrupted_at_import

START = {
    "the script": "from aero_planner.__main__ import main; sys.exit(main())",
    "the module": "import runpy; runpy.run_module('aero_planner', run_name='__main__')",
}


@pytest.mark.parametrize("start", START.values(), ids=START)
@pytest.mark.parametrize(
    ("call", "module"),
    [
        ("config show", "aero_planner.cli"),
        ("config show", "argparse"),
        ("config show", "aero_planner.termination"),
        ("config show", "importlib.metadata"),
        ("config show", "aero_planner.config.file"),
        ("run", "numpy"),
        ("preflight", "warp"),
    ],
)
def test_ctrl_c_during_imports_ends_quietly(start: str, call: str, module: str):
    done = interrupted_at_import(module, start, "aero-planner", *call.split())
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


@pytest.mark.parametrize(
    "start",
    [
        START["the script"],
        "from aero_planner.cli_util import run_command; run_command(lambda _: __import__('aero_planner.config.file'))",
    ],
)
def test_ctrl_c_while_an_object_is_finalized_is_not_lost(start: str):
    module = "aero_planner.config.file"
    done = interrupted_at_import(module, start, "aero-planner", "config", "show", finalizing=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


def test_the_garbage_collector_runs_again_after_the_imports():
    with pytest.raises(KeyboardInterrupt), quick_imports():
        assert not gc.isenabled()
        raise KeyboardInterrupt
    assert gc.isenabled()
