"""How kernels are made for a device: threads that share a task, wide reads, and the compiler's options.

On a CPU one thread does many things with the same vector instructions; on CUDA a warp or a block shares one.
"""

# No postponed annotations: native functions need the types themselves.

import functools
from typing import Any, NamedTuple

import warp as wp

__all__ = [
    "CPU",
    "CUDA",
    "Widths",
    "add_count",
    "block_type",
    "least_of",
    "of_thread",
    "read_block",
    "read_group",
    "sum_of",
    "take",
    "wait_for_block",
    "widths",
]

wp.set_module_options({"enable_backward": False})

_WARP = 32


class Widths(NamedTuple):
    """How much one thread does at once, and how many threads share one task."""

    cloud: int
    """Points of the cloud whose cells a thread finds."""
    samples: int
    """Samples that a thread rolls out."""
    points: int
    """Points that a thread compares a position with at once."""
    sums: int
    """Samples whose controls a thread adds at once."""
    improve: int = 1
    """Threads that weigh the samples of one instance."""
    steps: int = 1
    """Threads that share the steps of one instance."""
    query: int = 1
    """Threads that look at one position of Stage I, where few drones leave threads to spare."""
    team: int = 1
    """The same for Stage II, which has fewer positions."""
    cuda: bool = False
    """Whether the device is one of CUDA's."""

    def crowded(self) -> "Widths":
        """Return the widths for many drones, which leave no threads to spare."""
        return self._replace(improve=min(self.improve, 128), query=1, team=1)

    def tune(self, kernel: wp.Kernel, *, keep_loops: bool = False) -> wp.Kernel:
        """Return the kernel, which has a module of its own, with the compiler's options for the device.

        With `keep_loops`, loops over vectors stay loops on a CPU, which LLVM turns into vector instructions; short ones
        that Warp unrolls it does not. CUDA takes the hardware's own division and square root, right to one or two units
        in the last place of a float32: the exact ones branch, and a thread that waits for nothing but itself takes half
        as long again.
        """
        if self.cuda:
            kernel.module.options["fast_math"] = True
        elif keep_loops:
            kernel.module.options["max_unroll"] = 2
        return kernel


CPU = Widths(cloud=64, samples=32, points=16, sums=32)
"""What LLVM turns into vector instructions."""
CUDA = Widths(cloud=1, samples=1, points=4, sums=4, improve=512, steps=32, query=2, team=32, cuda=True)
"""A thread for each, and wide loads of points and samples."""


def widths(device: wp.Device) -> "Widths":
    """Return the widths of a device."""
    return CPU if device.is_cpu else CUDA


@wp.func
def only(x: float) -> float:
    """What a single thread has."""
    return x


@wp.func
def tile_least(x: float) -> float:
    """The least that any thread of the block has."""
    return wp.tile_extract(wp.tile_min(wp.tile(x)), 0)


# A butterfly takes the values in the same order in every thread, so that all get the same bits.
_BUTTERFLY = """
    float a = x;
#if defined(__CUDA_ARCH__)
    const unsigned all = (0xffffffffu >> (32 - threads)) << (threadIdx.x & (32 - threads));
    for (int step = threads / 2; step > 0; step /= 2) {
        const float b = __shfl_xor_sync(all, a, step);
        a = COMBINED;
    }
#endif
    return a;
"""


@wp.func_native(_BUTTERFLY.replace("COMBINED", "fminf(a, b)"))
def least_of_neighbours(x: float, threads: int) -> float:
    """The least that any of `threads` neighbours in a warp has."""
    ...


@wp.func_native(_BUTTERFLY.replace("COMBINED", "a + b"))
def sum_of_neighbours(x: float, threads: int) -> float:
    """The sum of what `threads` neighbours in a warp have."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __shfl_sync(0xffffffffu, x, thread);
#endif
    return x;
""")
def of_thread(x: float, thread: int) -> float:
    """What a thread of the warp has; all threads must ask. On a CPU there is one."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
""")
def wait_for_block():
    """Wait until all threads of the block are here and what they wrote can be read."""
    ...


@wp.func_native("""
    int before = 0;
#if defined(__CUDA_ARCH__)
    // One atomic operation for the whole warp, since those on one address wait for each other.
    const unsigned all = __activemask();
    const int lane = threadIdx.x & 31, last = 31 - __clz(all);
    int sum = count;
    for (int step = 1; step < 32; step *= 2) {
        const int lower = __shfl_up_sync(all, sum, step);
        if (lane >= step) sum += lower;
    }
    if (lane == last) before = wp::atomic_add(used, i, j, sum);
    before = __shfl_sync(all, before, last) + sum - count;
#else
    before = wp::atomic_add(used, i, j, count);
#endif
    return before;
""")
def take(used: wp.array2d(dtype=int), i: int, j: int, count: int) -> int:  # pyright: ignore
    """Add `count` to used[i, j] and return what it was; the threads of a warp must ask for the same i and j."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    // Atomic operations on one counter are serialised: the threads of a warp that count for the same j do one together.
    const unsigned active = __activemask();
    const unsigned counting = __ballot_sync(active, count != 0);
    if (counting == 0) return;
    const unsigned same = __match_any_sync(active, j) & counting;
    if (count != 0 && (threadIdx.x & 31) == __ffs(same) - 1) wp::atomic_add(counters, i, j, __popc(same));
#else
    if (count != 0) wp::atomic_add(counters, i, j, count);
#endif
""")
def add_count(counters: wp.array2d(dtype=int), i: int, j: int, count: int):  # pyright: ignore
    """Add `count` to counters[i, j]; on CUDA it must be 0 or 1, and the threads of a warp must agree on i."""
    ...


def block_type(width: int) -> Any:
    """Return the type of `width` points side by side: rows x, y, z [m].

    A CPU compares a position with a whole block at once. A row of cells begins and ends anywhere in a block: what else
    the block holds are points of the cloud, too.
    """
    return wp.types.matrix(shape=(3, width), dtype=wp.float32)


_Quad: Any = wp.types.vector(length=4, dtype=wp.float32)
_Points: Any = block_type(4)

# Of a vector a GPU would read one number after the other.


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4* rows = reinterpret_cast<const float4*>(wp::address(blocks, b, k));
    wp::mat_t<3, 4, wp::float32> block;
    for (int i = 0; i < 3; ++i) {
        const float4 row = __ldg(rows + i);
        block.data[i][0] = row.x, block.data[i][1] = row.y, block.data[i][2] = row.z, block.data[i][3] = row.w;
    }
    return block;
#else
    return wp::load(wp::address(blocks, b, k));
#endif
""")
def read_four_points(blocks: wp.array2d(dtype=_Points), b: int, k: int) -> _Points:  # pyright: ignore
    """blocks[b, k] by three wide loads."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4 x = __ldg(reinterpret_cast<const float4*>(wp::address(values, i, j, k)));
    return wp::vec_t<4, wp::float32>(x.x, x.y, x.z, x.w);
#else
    return wp::load(wp::address(values, i, j, k));
#endif
""")
def read_four_values(values: wp.array3d(dtype=_Quad), i: int, j: int, k: int) -> _Quad:  # pyright: ignore
    """values[i, j, k] by one wide load."""
    ...


@functools.cache
def read_block(width: int) -> wp.Function:
    """Return the function (blocks, b, k) that reads a block of `width` points."""
    Block: Any = block_type(width)

    @wp.func
    def read_block(blocks: wp.array2d(dtype=Block), b: int, k: int) -> Block:
        return blocks[b, k]

    return read_four_points if width == 4 else read_block


@functools.cache
def read_group(width: int) -> wp.Function:
    """Return the function (values, i, j, k) that reads `width` numbers side by side."""
    Reals: Any = wp.types.vector(length=width, dtype=wp.float32)

    @wp.func
    def read_group(values: wp.array3d(dtype=Reals), i: int, j: int, k: int) -> Reals:
        return values[i, j, k]

    return read_four_values if width == 4 else read_group


# Not tiles of one on a CPU: they share memory between the threads that launch.


@functools.cache
def least_of(threads: int) -> wp.Function:
    """Return the function that gives every thread the least value of all; `threads` is 1, a power of two within a warp,
    or the size of the block."""
    THREADS = wp.constant(threads)

    @wp.func
    def least_of_warp(x: float) -> float:
        return least_of_neighbours(x, THREADS)

    return only if threads == 1 else least_of_warp if threads <= _WARP else tile_least


@functools.cache
def sum_of(threads: int) -> wp.Function:
    """Return the function that gives every thread the sum of all values; `threads` is 1 or a power of two within a
    warp, so that the order of the sum does not depend on the size of a block."""
    THREADS = wp.constant(threads)

    @wp.func
    def sum_of_warp(x: float) -> float:
        return sum_of_neighbours(x, THREADS)

    return only if threads == 1 else sum_of_warp
