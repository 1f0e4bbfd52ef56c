import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import warp as wp

from aero_planner.deploy.aot import compile_ahead, warmup
from tests.planner.cases import config_of

AHEAD = """
import sys
import warp as wp
from aero_planner import compile_ahead
if len(sys.argv) > 2:
    wp.config.log_level = wp.LOG_DEBUG
print(*compile_ahead(sys.argv[1]), sep="\\n")
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


def run(program: str, *arguments: object, cache: Path) -> str:
    """Run a program whose kernels are cached in a folder; return what it prints."""
    command = [sys.executable, "-c", program, *map(str, arguments)]
    environment = {**os.environ, "WARP_CACHE_PATH": str(cache)}
    return subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout


@pytest.fixture(scope="module")
def kernels(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """A folder of kernels that were compiled without a cache, and the files that were reported."""
    folder = tmp_path_factory.mktemp("kernels")
    return folder, run(AHEAD, folder, cache=tmp_path_factory.mktemp("empty")).split()


def test_a_planner_needs_no_compiler_with_a_folder_of_kernels(kernels: tuple[Path, list[str]]):
    folder, reported = kernels
    ahead = files(folder)
    binaries = {name for name in ahead if name.endswith(".o")}
    assert {str(Path(path).relative_to(folder)) for path in reported} == binaries and len(binaries) > 8
    printed = run(PLAN, cache=folder)
    assert files(folder) == ahead
    warming, planning = printed.split("WARM")
    assert warming.count("(cached)") == len(binaries) and "(compiled)" not in warming
    assert LOADED not in planning and planning.endswith("OK\n")


def test_kernels_that_are_compiled_already_are_copied(kernels: tuple[Path, list[str]], tmp_path: Path):
    folder, _ = kernels
    damaged, *others = sorted(folder.rglob("*.o"))
    cache = shutil.copytree(folder, tmp_path / "cache")
    (cache / damaged.relative_to(folder)).write_bytes(b"damaged")
    printed = run(AHEAD, tmp_path / "copies", "with log", cache=cache)
    assert printed.count("(compiled)") == 1
    for path in others:
        assert (tmp_path / "copies" / path.relative_to(folder)).read_bytes() == path.read_bytes()
    assert (tmp_path / "copies" / damaged.relative_to(folder)).stat().st_size > 1000


def test_kernels_for_a_gpu_are_copied_once_they_are_compiled(
    bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(wp, "compile_aot_module", None)
    copies = compile_ahead(tmp_path, architectures=[87], cpu=False)
    assert {path.name for path in copies} == {path.name for path in bundle.glob("kernels/*/*.cubin")}
    for path in copies:
        assert path.read_bytes() == (bundle / "kernels" / path.parent.name / path.name).read_bytes()


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
