"""Exact distance to the nearest point of the filtered cloud, truncated where it no longer matters.

The space around the drone is cut into cubic cells at least as wide as the largest distance that is asked for, so that
all points that count for a position lie in the 27 cells around it. Points are sorted by cell, rows of cells along x one
after another. Every point is entered in the layers below and above its own, too, and where that pays (on a CPU) also in
the rows beside its own: the 27 cells are then one piece of the list, otherwise three. Nothing is approximated.
"""

# No postponed annotations: those of kernels that `width` shapes name local types.

import functools
from typing import Any

import warp as wp

from aero_planner.blocks import least_of_block
from aero_planner.costs import collision_cost
from aero_planner.params import Params

__all__ = [
    "FAR",
    "GRID",
    "above_floor",
    "allocate_rows",
    "block_type",
    "cell_size",
    "clearance_at",
    "count_points",
    "fill_rows",
    "keep_loops",
    "query_clearance",
    "row_limit",
]

wp.set_module_options({"enable_backward": False})

GRID = wp.constant(44)
"""Cells along each side of the grid; the outermost hold no points, so that every point has 27 cells around it."""

FAR = wp.constant(1.0e18)
"""Coordinate of what fills up the last block."""


def block_type(width: int) -> Any:
    """Return the type of `width` points side by side: rows x, y, z [m].

    A CPU compares a position with a whole block at once. A row of cells begins and ends anywhere in a block: what else
    the block holds are points of the cloud, too.
    """
    return wp.types.matrix(shape=(3, width), dtype=wp.float32)


@wp.func
def cell_size(params: Params) -> float:
    """Width of a cell [m]."""
    return wp.max(
        wp.max(params.distance_max, params.blocked_radius),
        wp.max(params.safe_clearance, 2.0 * params.range_max / float(GRID - 2)),
    )


@wp.func
def grid_coordinates(x: wp.vec3, center: wp.vec3, size: float) -> wp.vec3:
    """Position in cells from the grid's corner."""
    return (x - center) * (1.0 / size) + wp.vec3(0.5 * float(GRID), 0.5 * float(GRID), 0.5 * float(GRID))


@wp.func
def cell_of_point(x: wp.vec3, center: wp.vec3, size: float):
    c = grid_coordinates(x, center, size)
    # A point at exactly range_max may round to the cell past the last one.
    last = GRID - 2
    return wp.clamp(int(c[0]), 1, last), wp.clamp(int(c[1]), 1, last), wp.clamp(int(c[2]), 1, last)


@wp.kernel
def count_points(
    lane: int,
    lanes: int,
    occupied: wp.array2d(dtype=int),
    filtered: wp.array2d(dtype=wp.vec3),
    position: wp.array(dtype=wp.vec3),
    params: wp.array(dtype=Params),
    beside: int,
    end: wp.array2d(dtype=int),
):
    """Count the points of each cell in `end`; with `beside` 1 they also count in the rows beside their own. Launched
    over [B, fine cells]; a lane has every `lanes`-th layer of cells."""
    b, i = wp.tid()
    if occupied[b, i] == 0:
        return
    cx, cy, cz = cell_of_point(filtered[b, i], position[b], cell_size(params[b]))
    for z in range(cz - 1, cz + 2):
        if z % lanes == lane:
            for y in range(cy - beside, cy + beside + 1):
                wp.atomic_add(end, b, (z * GRID + y) * GRID + cx, 1)


@wp.kernel
def allocate_rows(
    lane: int,
    lanes: int,
    capacity: int,
    total: wp.array2d(dtype=int),
    counts: wp.array2d(dtype=wp.vec4i),
    end: wp.array2d(dtype=int),
):
    """Give each row of cells a piece of this lane's `capacity` points; `end` becomes where each cell begins.

    `counts` is the same memory by fours, since most rows are empty and have to be read only. Launched over [B, rows of
    the lane].
    Which piece a row gets depends on the order of the threads; the nearest distance does not.
    """
    b, i = wp.tid()
    first = ((i // GRID) * lanes + lane) * GRID * GRID + (i % GRID) * GRID
    four = wp.vec4i(0, 0, 0, 0)
    for x in range(GRID // 4):
        four += counts[b, first // 4 + x]
    length = four[0] + four[1] + four[2] + four[3]
    if length == 0:
        return
    cursor = lane * capacity + wp.atomic_add(total, lane, b, length)
    for x in range(GRID):
        count = end[b, first + x]
        end[b, first + x] = cursor
        cursor += count


@wp.kernel
def fill_rows(
    lane: int,
    lanes: int,
    capacity: int,
    occupied: wp.array2d(dtype=int),
    filtered: wp.array2d(dtype=wp.vec3),
    position: wp.array(dtype=wp.vec3),
    params: wp.array(dtype=Params),
    total: wp.array2d(dtype=int),
    beside: int,
    end: wp.array2d(dtype=int),
    coordinates: wp.array4d(dtype=float),
):
    """Write every point into its cells; `end` becomes where each cell ends, and the cell after it in the row begins.

    `coordinates` are those of the blocks, shape [B, blocks, 3, width]. Launched over [B, fine cells].
    """
    b, i = wp.tid()
    width = coordinates.shape[3]
    if i == 0:
        used = lane * capacity + total[lane, b]
        for slot in range(used, (used + width - 1) // width * width):
            coordinates[b, slot // width, 0, slot % width] = FAR
    if occupied[b, i] == 0:
        return
    point = filtered[b, i]
    cx, cy, cz = cell_of_point(point, position[b], cell_size(params[b]))
    for z in range(cz - 1, cz + 2):
        if z % lanes == lane:
            for y in range(cy - beside, cy + beside + 1):
                slot = wp.atomic_add(end, b, (z * GRID + y) * GRID + cx, 1)
                block = slot // width
                j = slot % width
                coordinates[b, block, 0, j] = point[0]
                coordinates[b, block, 1, j] = point[1]
                coordinates[b, block, 2, j] = point[2]


def keep_loops(kernel: wp.Kernel, width: int) -> wp.Kernel:
    """Let loops over wide blocks stay loops, which LLVM turns into vector instructions; unrolled ones it does not."""
    if width > 12:
        kernel.module.options["max_unroll"] = 2
    return kernel


@functools.cache
def clearance_at(width: int, threads: int) -> wp.Function:
    """Return the function that finds the nearest point in blocks of `width` points, with a thread block of `threads`.

    All threads of a block ask for the same position, and share the points.
    """
    THREADS = wp.constant(threads)
    block_min = least_of_block(threads)
    WIDTH, HALF, QUARTER = wp.constant(width), wp.constant(width // 2), wp.constant(width // 4)
    REST = wp.constant(max(QUARTER, 1))
    Reals: Any = wp.types.vector(length=width, dtype=wp.float32)
    Block: Any = block_type(width)

    @wp.func
    def clearance_at(
        x: wp.vec3,
        limit: float,
        b: int,
        thread: int,
        center: wp.vec3,
        size: float,
        beside: int,
        end: wp.array2d(dtype=int),
        blocks: wp.array2d(dtype=Block),
    ) -> float:
        """Distance from x to the nearest point [m], or `limit`, which must not exceed `size`, where that is farther."""
        c = grid_coordinates(x, center, size)
        cx = int(wp.floor(c[0]))
        cy = int(wp.floor(c[1]))
        cz = int(wp.floor(c[2]))
        if wp.min(cx, wp.min(cy, cz)) < 0 or wp.max(cx, wp.max(cy, cz)) >= GRID:
            return limit
        best = Reals(limit * limit)
        side = 1 - beside
        for y in range(wp.max(cy - side, 0), wp.min(cy + side, GRID - 1) + 1):
            row = (cz * GRID + y) * GRID
            # The first cell of a row is empty, so that the row begins where that one ends.
            first = end[b, row + wp.max(cx - 2, 0)]
            last = end[b, row + wp.min(cx + 1, GRID - 1)]
            if first < last:
                for k in range(first // WIDTH + thread, (last + WIDTH - 1) // WIDTH, THREADS):
                    block = blocks[b, k]
                    for j in range(WIDTH):
                        dx = block[0, j] - x[0]
                        dy = block[1, j] - x[1]
                        dz = block[2, j] - x[2]
                        d = dx * dx + dy * dy + dz * dz
                        best[j] = wp.where(d < best[j], d, best[j])
        # The least of all, by halves: at most four steps that wait for each other.
        for j in range(HALF):
            best[j] = wp.where(best[j + HALF] < best[j], best[j + HALF], best[j])
        for j in range(QUARTER):
            best[j] = wp.where(best[j + QUARTER] < best[j], best[j + QUARTER], best[j])
        least = best[0]
        for j in range(1, REST):
            least = wp.where(best[j] < least, best[j], least)
        least = block_min(least)
        return wp.where(least < limit * limit, wp.sqrt(least), limit)

    return clearance_at


@wp.func
def above_floor(d: float, x: wp.vec3, params: Params) -> float:
    """Distance d from x to the nearest point, or to the floor where that is nearer [m]."""
    return wp.min(d, wp.max(x[2] - params.floor, 0.0))


@wp.func
def row_limit(t: int, steps: int, params: Params) -> float:
    """Distance beyond which row t of a rollout need not be known [m]; rows from `steps` on are probes."""
    if t >= steps:
        return params.blocked_radius
    return wp.max(params.distance_max, params.safe_clearance)


@functools.cache
def query_clearance(width: int) -> wp.Kernel:
    """Return the kernel for blocks of `width` points."""
    clearance = clearance_at(width, 1)
    Block: Any = block_type(width)

    @wp.kernel(module="unique", enable_backward=False)
    def query_clearance(
        first: int,
        instances: int,
        steps: int,
        stride: int,
        positions: wp.array4d(dtype=float),
        center: wp.array(dtype=wp.vec3),
        params: wp.array(dtype=Params),
        beside: int,
        end: wp.array2d(dtype=int),
        blocks: wp.array2d(dtype=Block),
        cost: wp.array3d(dtype=float),
    ):
        """What the clearance of every position costs, shape [B M, N + probes, 3, K].

        Rows past `steps` probe the way to the goal: 1 where it is blocked, else 0. Launched over [instances of this
        chunk, N + probes, stride]; a thread takes every `stride`-th of the K positions.
        """
        offset, t, lane = wp.tid()
        i = first + offset
        b = i // instances
        c = params[b]
        if t >= steps and c.q_blocked == 0.0:
            return
        limit = row_limit(t, steps, c)
        size = cell_size(c)
        for k in range(lane, cost.shape[2], stride):
            x = wp.vec3(positions[i, t, 0, k], positions[i, t, 1, k], positions[i, t, 2, k])
            d = above_floor(clearance(x, limit, b, 0, center[b], size, beside, end, blocks), x, c)
            if t < steps:
                cost[i, t, k] = collision_cost(d, c)
            else:
                cost[i, t, k] = wp.where(d < c.blocked_radius, 1.0, 0.0)

    return keep_loops(query_clearance, width)
