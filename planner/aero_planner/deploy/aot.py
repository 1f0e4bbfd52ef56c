"""Kernels before they are needed: loaded into this process, or compiled into a folder for another one.

Warp compiles a kernel at its first launch and keeps the binary in its cache, so that the first planner on a machine
takes seconds to appear and every later one a fraction of one.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from aero_planner.config import PlannerConfig
from aero_planner.kernels.kernel_tuning import CUDA
from aero_planner.pipeline import made_kernels
from aero_planner.plan import Goal, VehicleState
from aero_planner.planner import Planner, _find_device

__all__ = ["compile_ahead", "kernels_in", "warmup"]

_BLOCK_DIMS = (32, 64, 128, 256)
"""Sizes of block on CUDA, each of which gives a binary of its own."""


def warmup(config: PlannerConfig | None = None, device: str = "cpu") -> float:
    """Compile and load every kernel that plans with `config`'s structure need, so that the first plan is fast.

    Args:
        config: parameters; None for the default.
        device: as for `Planner`.

    Returns:
        The time it took [s].

    Raises:
        ValueError: as for `Planner`.
    """
    started = time.perf_counter()
    planner = Planner(config, device=device)
    state = VehicleState(position=(0.0, 0.0, 0.0), velocity=(0.0, 0.0, 0.0), quaternion=(1.0, 0.0, 0.0, 0.0))
    planner.plan(state, Goal((5.0, 0.0, 0.0)), np.array([[2.0, 0.0, 0.0]]))
    planner.close()
    return time.perf_counter() - started


@contextmanager
def kernels_in(folder: str | Path) -> Iterator[Path]:
    """Let Warp keep its kernels in a folder, as it does with WARP_CACHE_PATH; yields where exactly."""
    _find_device("cpu")  # initialises Warp, which names its cache then
    cache = Path(folder).resolve() / wp.config.version
    cache.mkdir(parents=True, exist_ok=True)
    before, wp.config.kernel_cache_dir = wp.config.kernel_cache_dir, str(cache)
    try:
        yield cache
    finally:
        wp.config.kernel_cache_dir = before


def compile_ahead(
    folder: str | Path,
    *,
    architectures: Iterable[int] = (),
    cpu: bool = True,
    config: PlannerConfig | None = None,
) -> list[Path]:
    """Fill a folder with the kernels of this machine's CPU and of CUDA architectures, such as 87 for a Jetson Orin.

    No GPU is needed. A process started with the folder in the environment variable WARP_CACHE_PATH compiles nothing, if
    its Warp has the same version. Call this in a fresh process: kernels that are loaded already are not compiled again.

    Args:
        folder: where the binaries go; made where it does not exist.
        architectures: compute capabilities without the dot.
        cpu: whether the CPU's are wanted.
        config: parameters, for the structure that the CPU's kernels depend on; None for the default.

    Returns:
        All binaries in the folder.

    Raises:
        ValueError: Warp can't compile for an architecture.
        OSError: the folder can't be written.
    """
    with kernels_in(folder) as cache:
        if cpu:
            warmup(config)
        for architecture in architectures:
            _compile_for_cuda(architecture)
    return sorted(path for path in cache.rglob("*") if path.suffix in (".o", ".cubin", ".ptx"))


def _compile_for_cuda(architecture: int) -> None:
    for module, block_dims in _cuda_modules():
        default = module.options["block_dim"]
        try:
            for block_dim in block_dims:
                module.options["block_dim"] = block_dim
                wp.compile_aot_module(module, arch=architecture)
        except Exception as error:
            raise ValueError(
                f"kernels can't be compiled for architecture {architecture!r}: {error}; "
                "give a compute capability without its dot that Warp knows, such as 87 or 90."
            ) from error
        finally:
            module.options["block_dim"] = default


def _cuda_modules() -> Iterator[tuple[Any, Iterable[int]]]:
    """Every Warp module of the package, those made for CUDA's widths included, and its sizes of block there."""
    names = [name for name in sys.modules if name.startswith("aero_planner.")]
    content = {id(value): value for name in names for value in vars(sys.modules[name]).values()}.values()
    written = {id(value.module): value.module for value in content if isinstance(value, wp.Kernel)}
    yield from ((module, _BLOCK_DIMS) for module in written.values())
    yield from ((kernel.module, (block_dim,)) for kernel, block_dim in made_kernels(CUDA))
