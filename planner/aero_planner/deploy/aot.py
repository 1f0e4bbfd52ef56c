"""Ahead-of-time compilation of kernels, into this process or into a folder for another one.

Warp compiles a kernel at its first launch and keeps the binary in its cache. The first planner on a machine therefore
takes seconds to start, and every later one a fraction of a second.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from aero_planner.array_memory import allocate
from aero_planner.arrays import PlannerInputs, PlannerOutputs, Sizes, Workspace
from aero_planner.composition import Composition
from aero_planner.config import PlannerConfig
from aero_planner.device.kernel_tuning import CPU, CUDA, KernelTuning
from aero_planner.device.params import Params
from aero_planner.kernels.mppi import fill_noise
from aero_planner.kernels.partition import fill_directions
from aero_planner.pipeline import Pipeline
from aero_planner.plan import Goal, VehicleState
from aero_planner.planner import Planner
from aero_planner.recorder import PlannerArrays
from aero_planner.sweep_memory import SweepMemory
from aero_planner.sweeps import Sweeps
from aero_planner.warp_init import find_device, init_warp


def warmup(config: PlannerConfig | None = None, device: str = "cpu") -> float:
    """Compile and load every kernel that planning with the structure of `config` needs, so that the first plan is fast.

    Args:
        config: parameters; None for the default.
        device: as for `Planner`.

    Returns:
        The time this took [s].

    Raises:
        ValueError: as for `Planner`.
    """
    started = time.perf_counter()
    planner = Planner(config, device=device)
    load_kernels(planner)
    planner.close()
    return time.perf_counter() - started


def load_kernels(planner: Planner) -> None:
    """Plan twice, from rest in front of a single point, which compiles and loads every kernel of `planner`."""
    state = VehicleState(position=(0.0, 0.0, 0.0), velocity=(0.0, 0.0, 0.0), quaternion=(1.0, 0.0, 0.0, 0.0))
    point = np.array([[2.0, 0.0, 0.0]], dtype=np.float32)
    for cloud in (Sweeps([point]), point):
        planner.plan(state, Goal((5.0, 0.0, 0.0)), cloud)


@contextlib.contextmanager
def kernels_in(folder: str | Path) -> Iterator[Path]:
    """Make Warp keep its kernels in a folder, as with WARP_CACHE_PATH; yields the subfolder that Warp uses."""
    cache = _cache_in(folder)
    before, wp.config.kernel_cache_dir = wp.config.kernel_cache_dir, str(cache)
    try:
        yield cache
    finally:
        wp.config.kernel_cache_dir = before


def compile_ahead(
    folder: str | Path, *, architectures: Iterable[int] = (), cpu: bool = True, config: PlannerConfig | None = None
) -> list[Path]:
    """Compile all kernels of a planner into a folder, for this machine's CPU and for CUDA architectures, such as 87 for
    an Orin.

    They are copied from Warp's cache, where they may be already. No GPU is needed. A process that is started with the
    folder in the environment variable WARP_CACHE_PATH compiles nothing, if its Warp has the same version. Call this in
    a new process: kernels that are already loaded are not loaded again.

    Args:
        folder: folder for the binaries; created if it does not exist.
        architectures: GPU compute capabilities without the dot.
        cpu: True to compile for the CPU.
        config: parameters, on whose structure the kernels depend: the vehicle model and the stages; None for the
            default. The kernels are those of one drone.

    Returns:
        All binaries in the folder.

    Raises:
        ValueError: Warp can't compile for an architecture.
        OSError: the folder can't be written.
    """
    cache, config = _cache_in(folder), config or PlannerConfig()
    if cpu:
        warmup(config)
        _copy_kernels_for_cpu(config, cache)
    for architecture in architectures:
        _compile_for_cuda(config, architecture, cache)
    return sorted(path for path in cache.rglob("*") if path.suffix in (".o", ".cubin", ".ptx"))


def kernels_of_planner(config: PlannerConfig, tuning: KernelTuning) -> list[tuple[wp.Kernel, int]]:
    """Return each kernel that a planner for one drone launches, and the block size, on a device with this tuning.

    No such device is needed: the arrays are those of the CPU, and nothing is launched.
    """
    cpu, composition = find_device("cpu"), Composition.of(config)
    sizes = Sizes.from_config(config, composition, batch=1, workers=1, tuning=tuning)

    def made(kind: type | None) -> Any:
        return None if kind is None else allocate(kind, sizes, cpu)

    of_stages = {stage.name: (made(stage.arrays), made(stage.outputs)) for stage in composition.stages}
    inputs, outputs, work = made(PlannerInputs), made(PlannerOutputs), made(Workspace)
    memory = SweepMemory(cpu, 1, sweeps=1, points=1)
    params = wp.zeros(1, dtype=Params, device=cpu)
    arrays = PlannerArrays(inputs, outputs, work, of_stages, memory.arrays, memory.change, params)
    pipeline = Pipeline(config, composition, sizes, tuning, arrays, dry=True)
    tables = [(fill_directions, 256), (fill_noise, 256)]  # of a new planner
    return list(dict.fromkeys([*tables, *pipeline.kernels]))


def _cache_in(folder: str | Path) -> Path:
    """Return the subfolder of a cache that this version of Warp uses, after creating it."""
    init_warp()  # Warp then sets its cache folder
    cache = Path(folder).resolve() / wp.config.version
    cache.mkdir(parents=True, exist_ok=True)
    return cache


def _copy_kernels_for_cpu(config: PlannerConfig, folder: Path) -> None:
    """Copy the kernels for the CPU that this process has loaded from Warp's cache into a folder."""
    for module in {kernel.module for kernel, _ in kernels_of_planner(config, CPU)}:
        for context, block_dim in module.execs:
            if context is None:  # that of the CPU
                name = module.get_module_identifier(block_dim)
                (folder / name).mkdir(exist_ok=True)
                for path in Path(wp.config.kernel_cache_dir or "", name).iterdir():
                    if path.suffix in (".o", ".meta"):
                        shutil.copyfile(path, folder / name / path.name)


def _compile_for_cuda(config: PlannerConfig, architecture: int, folder: Path) -> None:
    """Copy the kernels for a GPU from Warp's cache into a folder, after compiling those that are not there."""
    for module, block_dims in _modules_for_cuda(config).items():
        default = module.options["block_dim"]
        try:
            for block_dim in block_dims:
                module.options["block_dim"] = block_dim
                name = module.get_module_identifier(block_dim)
                cached, target = Path(wp.config.kernel_cache_dir or "", name), folder / name
                if not any(cached.glob(f"*.sm{architecture}.cubin")):
                    wp.compile_aot_module(module, arch=architecture, module_dir=target)
                    _keep(target, cached)
                elif cached.resolve() != target.resolve():
                    target.mkdir(exist_ok=True)
                    for path in (*cached.glob(f"*.sm{architecture}.cubin"), *cached.glob("*.meta")):
                        shutil.copyfile(path, target / path.name)
        except Exception as error:
            raise ValueError(
                f"kernels can't be compiled for architecture {architecture!r}: {error}; "
                "give a compute capability without its dot that Warp knows, such as 87 or 90."
            ) from error
        finally:
            module.options["block_dim"] = default


def _keep(compiled: Path, cached: Path) -> None:
    """Copy the kernels of a module for a GPU into Warp's cache, which never holds a part of a file."""
    with contextlib.suppress(OSError):  # the next export compiles them again
        cached.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cached) as temporary:
            for path in (*compiled.glob("*.meta"), *compiled.glob("*.cubin")):
                os.replace(shutil.copyfile(path, Path(temporary, path.name)), cached / path.name)


def _modules_for_cuda(config: PlannerConfig) -> dict[Any, set[int]]:
    """Return the Warp modules of a planner on CUDA, and the block sizes of each one, which have their own binaries."""
    modules: dict[Any, set[int]] = {}
    for kernel, block_dim in kernels_of_planner(config, CUDA):
        modules.setdefault(kernel.module, set()).add(block_dim)
    return modules
