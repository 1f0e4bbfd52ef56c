"""Operations that Warp lacks: reductions and broadcasts within a warp, combined atomics, and wide loads.

On a CPU, where one thread does the whole task, each of them reduces to its trivial form.
"""

# Postponed annotations are left out: native functions need the types themselves.

import functools
from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})

_WARP = 32


@wp.func
def identity(x: float) -> float:
    """Return x, the reduction over a single thread."""
    return x


@wp.func
def block_minimum(x: float) -> float:
    """Return the minimum of x over all threads of the block."""
    return wp.tile_extract(wp.tile_min(wp.tile(x)), 0)


# A butterfly combines the values in the same order in every thread, so that all threads get the same bits.
_BUTTERFLY = """
    float a = x;
#if defined(__CUDA_ARCH__)
    const unsigned group = (0xffffffffu >> (32 - threads)) << (threadIdx.x & (32 - threads));
    for (int step = threads / 2; step > 0; step /= 2) {
        const float b = __shfl_xor_sync(group, a, step);
        a = COMBINED;
    }
#endif
    return a;
"""


@wp.func_native(_BUTTERFLY.replace("COMBINED", "fminf(a, b)"))
def warp_minimum(x: float, threads: int) -> float:
    """Return the minimum of x over `threads` neighbouring lanes of a warp."""
    ...


@wp.func_native(_BUTTERFLY.replace("COMBINED", "a + b"))
def warp_sum(x: float, threads: int) -> float:
    """Return the sum of x over `threads` neighbouring lanes of a warp."""
    ...


_READ_LANE = """
#if defined(__CUDA_ARCH__)
    return __shfl_sync(0xffffffffu, x, lane);
#endif
    return x;
"""


@wp.func_native(_READ_LANE)
def read_lane(x: float, lane: int) -> float:
    """Return the value of x in one lane of the warp; all lanes must call it. A CPU has one lane."""
    ...


@wp.func_native(_READ_LANE)
def read_lane_integer(x: int, lane: int) -> int:
    """Return the value of x in one lane of the warp, like `read_lane`."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __fdividef(x, y);
#else
    return x / y;
#endif
""")
def near_quotient(x: float, y: float) -> float:
    """Return x / y, on CUDA to two units in the last place: the exact quotient takes ten instructions and a branch."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return x * rsqrtf(fmaxf(x, 1.0e-30f));
#else
    return sqrtf(x);
#endif
""")
def near_root(x: float) -> float:
    """Return the square root of x >= 0, on CUDA to three units in the last place, like `near_quotient`."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
""")
def synchronize_block():
    """Wait until all threads of the block have arrived and their writes are visible."""
    ...


@wp.func_native("""
    int before = 0;
#if defined(__CUDA_ARCH__)
    // One atomic operation for the whole warp: operations on the same address are serialised.
    const unsigned active = __activemask();
    const int lane = threadIdx.x & 31, last = 31 - __clz(active);
    int sum = count;
    for (int step = 1; step < 32; step *= 2) {
        const int lower = __shfl_up_sync(active, sum, step);
        if (lane >= step) sum += lower;
    }
    if (lane == last) before = wp::atomic_add(used, i, j, sum);
    before = __shfl_sync(active, before, last) + sum - count;
#else
    before = wp::atomic_add(used, i, j, count);
#endif
    return before;
""")
def claim_slots(used: wp.array2d(dtype=int), i: int, j: int, count: int) -> int:  # pyright: ignore
    """Add `count` to used[i, j] and return its value before; the threads of a warp must pass the same i and j."""
    ...


@wp.func_native("""
    int before = 0;
#if defined(__CUDA_ARCH__)
    // One atomic operation for the threads of the warp with the same counter.
    const unsigned active = __activemask();
    const unsigned same = __match_any_sync(active, reinterpret_cast<unsigned long long>(wp::address(used, i, j)));
    const int lane = threadIdx.x & 31, leader = __ffs(same) - 1;
    if (lane == leader) before = wp::atomic_add(used, i, j, __popc(same));
    before = __shfl_sync(active, before, leader) + __popc(same & ((1u << lane) - 1u));
#else
    before = wp::atomic_add(used, i, j, 1);
#endif
    return before;
""")
def claim_slot(used: wp.array2d(dtype=int), i: int, j: int) -> int:  # pyright: ignore
    """Add 1 to used[i, j] and return its value before."""
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
    """Add `count` to counters[i, j]; on CUDA it must be 0 or 1, and the threads of a warp must pass the same i."""
    ...


def point_pack(width: int) -> Any:
    """Return the type of a pack of `width` points: a matrix with rows x, y, z [m].

    A CPU compares a position with a whole pack at once. A range of cells may begin and end anywhere in a pack; the
    other points of the pack belong to the cloud as well and do no harm.
    """
    return wp.types.matrix(shape=(3, width), dtype=wp.float32)


_FourValues: Any = wp.types.vector(length=4, dtype=wp.float32)
_FourPoints: Any = point_pack(4)

# A GPU would load the components of a vector one after the other.


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    // The last axis is contiguous. Its stride is not known to the compiler, which would multiply by it in 64 bits.
    const float4* rows = reinterpret_cast<const float4*>(wp::address(packs, b, 0)) + 3 * k;
    wp::mat_t<3, 4, wp::float32> pack;
    for (int i = 0; i < 3; ++i) {
        const float4 row = __ldg(rows + i);
        pack.data[i][0] = row.x, pack.data[i][1] = row.y, pack.data[i][2] = row.z, pack.data[i][3] = row.w;
    }
    return pack;
#else
    return wp::load(wp::address(packs, b, k));
#endif
""")
def read_four_points(packs: wp.array2d(dtype=_FourPoints), b: int, k: int) -> _FourPoints:  # pyright: ignore
    """Return packs[b, k] by three 16-byte loads."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4 x = __ldg(reinterpret_cast<const float4*>(wp::address(values, i, j, 0)) + k);
    return wp::vec_t<4, wp::float32>(x.x, x.y, x.z, x.w);
#else
    return wp::load(wp::address(values, i, j, k));
#endif
""")
def read_four_values(values: wp.array3d(dtype=_FourValues), i: int, j: int, k: int) -> _FourValues:  # pyright: ignore
    """Return values[i, j, k] by one 16-byte load."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4 x = __ldg(reinterpret_cast<const float4*>(wp::address(values, i, 0)) + k);
    return wp::vec_t<4, wp::float32>(x.x, x.y, x.z, x.w);
#else
    return wp::load(wp::address(values, i, k));
#endif
""")
def read_vector(values: wp.array2d(dtype=wp.vec4), i: int, k: int) -> wp.vec4:  # pyright: ignore
    """Return values[i, k] by one 16-byte load."""
    ...


@wp.func_native("""
    return wp::address(keys, i, j, 0)[k];
""")
def read_key(keys: wp.array3d(dtype=wp.uint64), i: int, j: int, k: int) -> wp.uint64:  # pyright: ignore
    """Return keys[i, j, k]; the last axis is contiguous."""
    ...


@functools.cache
def read_point_pack(width: int) -> wp.Function:
    """Return the function (packs, b, k) that reads a pack of `width` points."""
    Pack: Any = point_pack(width)

    @wp.func
    def read_point_pack(packs: wp.array2d(dtype=Pack), b: int, k: int) -> Pack:
        return packs[b, k]

    return read_four_points if width == 4 else read_point_pack


@functools.cache
def read_values(width: int) -> wp.Function:
    """Return the function (values, i, j, k) that reads `width` consecutive numbers."""
    Reals: Any = wp.types.vector(length=width, dtype=wp.float32)

    @wp.func
    def read_values(values: wp.array3d(dtype=Reals), i: int, j: int, k: int) -> Reals:
        return values[i, j, k]

    return read_four_values if width == 4 else read_values


# On a CPU, tiles of one thread would share memory between the threads that launch kernels.


@functools.cache
def minimum_over(threads: int) -> wp.Function:
    """Return the function that gives every thread the minimum over `threads` threads.

    Args:
        threads: 1, a power of two within a warp, or the size of the block.
    """
    THREADS = wp.constant(threads)

    @wp.func
    def minimum_in_warp(x: float) -> float:
        return warp_minimum(x, THREADS)

    return identity if threads == 1 else minimum_in_warp if threads <= _WARP else block_minimum


@functools.cache
def sum_over(threads: int) -> wp.Function:
    """Return the function that gives every thread the sum over `threads` threads.

    Args:
        threads: 1 or a power of two within a warp, so that the order of the sum does not depend on the block size.
    """
    THREADS = wp.constant(threads)

    @wp.func
    def sum_in_warp(x: float) -> float:
        return warp_sum(x, THREADS)

    return identity if threads == 1 else sum_in_warp
