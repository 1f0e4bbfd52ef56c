import os
import subprocess
import sys
from pathlib import Path

import pytest
import warp as wp

from aero_planner.deploy.aot import compile_ahead, warmup
from tests.planner.cases import config_of

AHEAD = "import sys; from aero_planner import compile_ahead; print(*compile_ahead(sys.argv[1]), sep='\\n')"
PLAN = """
import warp as wp
wp.config.log_level = wp.LOG_DEBUG
from aero_planner import Goal, Planner, VehicleState
from aero_planner.deploy.aot import warmup
assert warmup() > 0.0
print("WARM")
state = VehicleState([0, 0, 2], [4, 0, 0], [1, 0, 0, 0])
print(Planner(seed=1).plan(state, Goal([30, 0, 2]), [[5.0, 0, 2]]).status.name)
"""
LOADED = "load on device"
"""Part of the message that Warp prints for each module that it loads."""


def files(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def test_a_planner_needs_no_compiler_with_a_folder_of_kernels(tmp_path: Path):
    made = subprocess.run([sys.executable, "-c", AHEAD, str(tmp_path)], check=True, capture_output=True, text=True)
    ahead = files(tmp_path)
    binaries = {name for name in ahead if name.endswith(".o")}
    assert {str(Path(path).relative_to(tmp_path)) for path in made.stdout.split()} == binaries and len(binaries) > 8
    done = subprocess.run(
        [sys.executable, "-c", PLAN], env={**os.environ, "WARP_CACHE_PATH": str(tmp_path)}, check=True,
        capture_output=True, text=True,
    )  # fmt: skip
    assert files(tmp_path) == ahead
    warming, planning = done.stdout.split("WARM")
    assert warming.count("(cached)") == len(binaries) and "(compiled)" not in warming
    assert LOADED not in planning and planning.endswith("OK\n")


def test_warmup_on_every_device(device: str):
    assert warmup(config_of(sampling__steps=12), device) > 0.0


def test_warmup_refuses_an_unknown_device():
    with pytest.raises(ValueError, match="device 'gpu' is not available"):
        warmup(device="gpu")


@pytest.mark.parametrize("architecture", [12, "orin"])
def test_unknown_architectures_are_refused_and_the_cache_folder_is_restored(architecture: object, tmp_path: Path):
    cache = wp.config.kernel_cache_dir
    with pytest.raises(ValueError, match=rf"can't be compiled for architecture {architecture!r}"):
        compile_ahead(tmp_path, architectures=[architecture])  # type: ignore[list-item]
    assert wp.config.kernel_cache_dir == cache
