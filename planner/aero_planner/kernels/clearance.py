"""Exact distance to the nearest point of the filtered cloud, truncated where it no longer matters.

The space around the drone is cut into cubic cells at least as wide as the largest distance that is asked for, so that
all points that count for a position lie in the 27 cells around it; those out of its reach are left out. Points are
sorted by cell, rows of cells along x one after another. Every point is entered in the layers below and above its own,
too, and where that pays (on a CPU) also in the rows beside its own: the 27 cells are then one piece of the list,
otherwise three. Nothing is approximated.
"""

# No postponed annotations: those of kernels that `width` shapes name local types.

import functools
from typing import Any

import warp as wp

from aero_planner.kernels.costs import collision_cost
from aero_planner.kernels.kernel_tuning import Widths, block_type, least_of, read_block, take
from aero_planner.kernels.params import Params

__all__ = [
    "FAR",
    "GRID",
    "above_ground",
    "allocate_rows",
    "cell_size",
    "clearance_at",
    "count_points",
    "fill_rows",
    "query_clearance",
    "row_limit",
]

wp.set_module_options({"enable_backward": False})

GRID = wp.constant(44)
"""Cells along each side of the grid; the outermost hold no points, so that every point has 27 cells around it."""

Row: Any = wp.types.matrix(shape=(44 // 4, 4), dtype=wp.int32)
"""Counts of a row of cells, by fours."""

FAR = wp.constant(1.0e18)
"""Coordinate of what fills up the last block."""


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
    rows: int,
    capacity: int,
    total: wp.array2d(dtype=int),
    counts: wp.array2d(dtype=wp.vec4i),
):
    """Give each row of cells a piece of this lane's `capacity` points; counts become where each cell begins.

    `counts` is `end` by fours. Launched over [B, rows of the lane, filled up to whole warps of 32].

    Which piece a row gets depends on the order of the threads; the nearest distance does not.
    """
    b, i = wp.tid()
    row = Row()
    length = int(0)
    first = ((i // GRID) * lanes + lane) * GRID * GRID + (i % GRID) * GRID
    if i < rows:
        # Read at once, so that a GPU waits for memory once.
        for x in range(GRID // 4):
            row[x] = counts[b, first // 4 + x]
        for x in range(GRID // 4):
            length += row[x, 0] + row[x, 1] + row[x, 2] + row[x, 3]
    cursor = lane * capacity + take(total, lane, b, length)
    if length == 0:
        return
    for x in range(GRID // 4):
        begin = wp.vec4i(cursor, cursor + row[x, 0], cursor + row[x, 0] + row[x, 1], 0)
        begin[3] = begin[2] + row[x, 2]
        counts[b, first // 4 + x] = begin
        cursor = begin[3] + row[x, 3]


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


@functools.cache
def clearance_at(width: int, threads: int) -> wp.Function:
    """Return the function that finds the nearest point in blocks of `width` points, with `threads` that share them.

    Those are neighbours in a warp and ask for the same position.
    """
    THREADS = wp.constant(threads)
    least_of_all, read = least_of(threads), read_block(width)
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
        if wp.min(c) < 0.0 or wp.max(c) >= float(GRID):
            return limit
        # In cells, a little more than the limit, whatever the rounding.
        reach = limit / size + 1.0e-4
        side = wp.where(beside == 0, reach, 0.0)
        best = Reals(limit * limit)
        for y in range(int(wp.max(c[1] - side, 0.0)), int(wp.min(c[1] + side, float(GRID - 1))) + 1):
            row = (int(c[2]) * GRID + y) * GRID
            # The first cell of a row is empty, so that the row begins where that one ends.
            first = end[b, row + int(wp.max(c[0] - reach - 1.0, 0.0))]
            last = end[b, row + int(wp.min(c[0] + reach, float(GRID - 1)))]
            if first < last:
                for k in range(first // WIDTH + thread, (last + WIDTH - 1) // WIDTH, THREADS):
                    block = read(blocks, b, k)
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
        least = least_of_all(least)
        return wp.where(least < limit * limit, wp.sqrt(least), limit)

    return clearance_at


@wp.func
def above_ground(d: float, x: wp.vec3, ground_height: float, params: Params) -> float:
    """Return the smaller of d, the distance from x to the nearest point, and the height of x above the ground [m].

    `ground_height` is -inf where the ground is unknown.
    """
    return wp.where(params.use_ground != 0, wp.min(d, wp.max(x[2] - ground_height, 0.0)), d)


@wp.func
def row_limit(t: int, steps: int, params: Params) -> float:
    """Distance beyond which row t of a rollout need not be known [m]; rows from `steps` on are probes."""
    if t >= steps:
        return params.blocked_radius
    return wp.max(params.distance_max, params.safe_clearance)


@functools.cache
def query_clearance(of: Widths) -> wp.Kernel:
    """Return the kernel with a team of `of.query` threads for each position."""
    THREADS = wp.constant(of.query)
    clearance = clearance_at(of.points, of.query)
    Block: Any = block_type(of.points)

    @wp.kernel(module="unique", enable_backward=False)
    def query_clearance(
        first: int,
        instances: int,
        steps: int,
        stride: int,
        positions: wp.array4d(dtype=float),
        center: wp.array(dtype=wp.vec3),
        ground_height: wp.array(dtype=float),
        params: wp.array(dtype=Params),
        beside: int,
        end: wp.array2d(dtype=int),
        blocks: wp.array2d(dtype=Block),
        cost: wp.array3d(dtype=float),
    ):
        """What the clearance of every position costs, shape [B M, N + probes, 3, K].

        Rows past `steps` probe the way to the goal: 1 where it is blocked, else 0. Launched over [instances of this
        chunk, N + probes, stride of.query]; a team takes every `stride`-th of the K positions.
        """
        offset, t, place = wp.tid()
        lane = place // THREADS
        thread = place % THREADS
        i = first + offset
        b = i // instances
        c = params[b]
        if t >= steps and c.q_blocked == 0.0:
            return
        limit = row_limit(t, steps, c)
        size = cell_size(c)
        for k in range(lane, cost.shape[2], stride):
            x = wp.vec3(positions[i, t, 0, k], positions[i, t, 1, k], positions[i, t, 2, k])
            d = clearance(x, limit, b, thread, center[b], size, beside, end, blocks)
            d = above_ground(d, x, ground_height[b], c)
            if thread == 0:
                cost[i, t, k] = wp.where(t < steps, collision_cost(d, c), wp.where(d < c.blocked_radius, 1.0, 0.0))

    return of.tune(query_clearance, keep_loops=True)
