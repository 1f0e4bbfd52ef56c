import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import warp as wp

from aero_planner.deploy.aot import compile_ahead, warmup
from tests.planner.cases import config_of

AHEAD = """
import importlib, sys
warmup = importlib.import_module("aero_planner.deploy.aot")
warmup._BLOCK_DIMS = (256,)  # each takes as long as all of this
warmup.compile_ahead(sys.argv[1], architectures=[87])
from aero_planner.kernels.kernel_tuning import CUDA
from aero_planner.pipeline import tuned_kernels
print(*(kernel.module.name for kernel, _ in tuned_kernels(CUDA)), file=open(sys.argv[1] + "/made", "w"))
"""
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


def module_of(name: str) -> str:
    """Return the module of a binary, such as "wp_aero_planner.kernels.mppi" for "wp_.._b07ce23.o"."""
    return re.sub(r"_[0-9a-f]{7}.*", "", Path(name).name)


def test_a_planner_needs_no_compiler_with_a_folder_of_kernels(tmp_path: Path):
    subprocess.run([sys.executable, "-c", AHEAD, str(tmp_path)], check=True, capture_output=True)
    made = (tmp_path / "made").read_text().split()
    (tmp_path / "made").unlink()
    ahead = files(tmp_path)
    for name in made:  # with the widths that the pipeline has on a GPU
        assert any(f"/wp_{name}_" in path and path.endswith(".sm87.cubin") for path in ahead), name
    binaries = [name for name in ahead if name.endswith(".o")]
    # Kernels for a GPU may process one sample or point per thread, and then have another hash.
    on_cuda = {module_of(name) for name in ahead if name.endswith(".sm87.cubin")}
    only_on_cpu = {f"wp_{name}__locals__{name}" for name in ("prove_stops", "query_sample_vectors")}
    assert (
        on_cuda | only_on_cpu
        >= {module_of(name) for name in binaries}
        > {"wp_aero_planner.kernels.mppi", "wp_aero_planner.kernels.selection"} | only_on_cpu
    )
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
