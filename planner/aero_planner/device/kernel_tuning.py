"""Work per thread of each kernel on a CPU and on CUDA, and the compiler options that go with it.

A CPU thread handles many points or samples with vector instructions. On CUDA a thread handles one, and several threads
share an instance, a position or a sum.
"""

from __future__ import annotations

from typing import NamedTuple

import warp as wp

_FEW_DRONES = 2
"""Largest batch that leaves a GPU idle threads."""


_SCAN_THREADS = 2**15
"""Threads that scan the cloud. More of them, each with its own preparation, are no faster on an H100."""
_FEWEST_SCAN_THREADS = 128
"""Fewest threads that share a sweep."""


class KernelTuning(NamedTuple):
    """Work per thread, and threads per task, of the kernels of one kind of device."""

    points_per_thread: int
    """Points that a thread assigns to cells."""
    samples_per_thread: int
    """Samples that a thread rolls out."""
    points_per_pack: int
    """Points that a thread compares with a position at once."""
    samples_per_read: int
    """Samples whose controls a thread reads and sums at once."""
    cells_per_thread: int
    """Fine cells that a thread handles one after another: a CPU computes what they share once."""
    threads_per_update: int = 1
    """Threads that weight the samples of one instance; on CUDA they form a thread block."""
    threads_per_instance: int = 1
    """Threads that share the time steps of one instance."""
    rows_per_sample_query: int = 1
    """Time steps whose Stage I positions a thread queries one after another."""
    threads_per_sample_query: int = 1
    """Threads that share the clearance query of one Stage I position."""
    threads_per_query: int = 1
    """Threads that share the clearance query of one Stage II position; there are fewer of those."""
    threads_per_stop_query: int = 1
    """Threads that share the clearance query of one position of a stop; there are many of those."""
    rows_per_stop_query: int = 1
    """Positions of a stop that a thread queries one after another."""
    duplicate_rows: int = 0
    """1 if the grid of points stores each point in the neighbouring rows as well, else 0."""
    is_cuda: bool = False

    def for_batch(self, batch: int) -> KernelTuning:
        """Return the tuning for `batch` drones: many drones leave a GPU no idle threads to share a query."""
        if batch <= _FEW_DRONES or not self.is_cuda:
            return self
        return self._replace(
            threads_per_update=min(self.threads_per_update, 128),
            rows_per_sample_query=8,
            threads_per_sample_query=1,
            threads_per_query=1,
            threads_per_stop_query=1,
            duplicate_rows=0,
        )

    def threads_per_sweep(self, sweeps: int, points: int) -> int:
        """Return how many threads scan each sweep, of which there are `sweeps` in all, with at most `points` points."""
        if not self.is_cuda:
            return 1
        return max(_FEWEST_SCAN_THREADS, -(-min(_SCAN_THREADS // sweeps, points) // 32) * 32)

    def set_options(self, kernel: wp.Kernel, *, keep_loops: bool = False) -> wp.Kernel:
        """Set the compiler options of a kernel with a module of its own, and return the kernel.

        On CUDA, division and square root are the hardware's, exact to one or two units in the last place of a float32.
        The exact versions branch and make a latency-bound thread take half as long again.

        Args:
            kernel: the kernel.
            keep_loops: on a CPU, keep short loops instead of unrolling them, so that LLVM vectorises them.
        """
        if self.is_cuda:
            kernel.module.options["fast_math"] = True
        elif keep_loops:
            kernel.module.options["max_unroll"] = 2
        kernel.module.mark_modified()  # Warp has hashed the module with its options before
        return kernel


CPU = KernelTuning(
    points_per_thread=64, samples_per_thread=32, points_per_pack=16, samples_per_read=32, cells_per_thread=64,
    rows_per_stop_query=1000, duplicate_rows=1,
)  # fmt: skip
"""Sizes that LLVM turns into vector instructions."""
CUDA = KernelTuning(
    points_per_thread=1, samples_per_thread=1, points_per_pack=4, samples_per_read=4, cells_per_thread=1,
    threads_per_update=512, threads_per_instance=32, threads_per_sample_query=2, threads_per_query=32,
    threads_per_stop_query=8, duplicate_rows=1, is_cuda=True,
)  # fmt: skip
"""One point or sample per thread, and 16-byte loads of points and samples."""
