import shutil
import subprocess
import sys

import pytest

COMMAND = """
import sys
import warp as wp
{level}
wp.config.use_precompiled_headers = False  # which take longer than a single kernel
from aero_planner.warp_init import init_warp

init_warp()
print("the result")

@wp.kernel
def fill(values: wp.array(dtype=float)):
    values[wp.tid()] = 1.0

wp.launch(fill, dim=3, outputs=[wp.zeros(3, device="cpu")], device="cpu")
print("a warning", file=sys.stderr)
"""
PLAN = """
import sys
from aero_planner import Goal, Planner, PlannerConfig, VehicleState

planner = Planner(PlannerConfig().replace({"sampling.samples": 4}))
planner.plan(VehicleState([0, 0, 2], [3, 0, 0], [1, 0, 0, 0]), Goal([20, 0, 2]), [[5.0, 0, 2]])
print("the result")
print("a warning", file=sys.stderr)
"""


def output_of(folder, program: str) -> tuple[str, str]:
    """Run a program and return what it writes to stdout and stderr."""
    (folder / "program.py").write_text(program)
    done = subprocess.run([sys.executable, str(folder / "program.py")], capture_output=True, text=True, check=True)
    return done.stdout, done.stderr


@pytest.mark.parametrize("program", [COMMAND.format(level=""), PLAN], ids=["a kernel", "a plan"])
def test_both_outputs_belong_to_the_program(tmp_path, program):
    assert output_of(tmp_path, program) == ("the result\n", "a warning\n")


@pytest.mark.parametrize("level", ["LOG_DEBUG", "LOG_ERROR"])
def test_another_log_level_is_kept(tmp_path, level):
    chosen = output_of(tmp_path, COMMAND.format(level=f"wp.config.log_level = wp.{level}"))[0]
    assert ("Module" in chosen) == (level == "LOG_DEBUG")


def test_a_service_may_have_closed_stderr(tmp_path):
    program = "import os, sys\nos.close(2)\nsys.stderr = None\n" + PLAN.replace("import sys\n", "", 1)
    assert output_of(tmp_path, program.replace('print("a warning", file=sys.stderr)', ""))[0] == "the result\n"


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """A folder with the compiled kernels of `COMMAND`."""
    folder = tmp_path_factory.mktemp("compiled")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("WARP_CACHE_PATH", str(folder / "cache"))
        output_of(folder, COMMAND.format(level=""))
    return folder / "cache"


@pytest.fixture
def cache(compiled, tmp_path, monkeypatch):
    """A folder for compiled kernels that holds those of `COMMAND`."""
    monkeypatch.setenv("WARP_CACHE_PATH", str(tmp_path / "cache"))
    return shutil.copytree(compiled, tmp_path / "cache")


@pytest.mark.parametrize(("suffix", "keep"), [("o", 1000), ("meta", 0)])
def test_a_damaged_kernel_is_named_and_compiled_again(cache, suffix, keep):
    (damaged,) = cache.rglob(f"*.{suffix}")
    damaged.write_bytes(damaged.read_bytes()[:keep])
    printed, warnings = output_of(cache.parent, COMMAND.format(level=""))
    assert printed == "the result\n"
    assert str(damaged.parent) in warnings and "are compiled again" in warnings and "Traceback" not in warnings


def test_another_folder_replaces_a_cache_that_cannot_be_used(tmp_path, monkeypatch):
    (tmp_path / "cache").write_text("a file")
    monkeypatch.setenv("WARP_CACHE_PATH", str(tmp_path / "cache"))
    printed, warnings = output_of(tmp_path, COMMAND.format(level=""))
    assert printed == "the result\n"
    assert "aero-planner-kernels-" in warnings and "is used instead" in warnings
