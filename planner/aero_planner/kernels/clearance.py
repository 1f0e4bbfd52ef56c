"""Exact distance to the nearest point of the filtered cloud, truncated where it no longer matters.

A grid of cubic cells surrounds the drone. Its cells are at least as wide as the largest distance that is queried, so
that the 27 cells around a position contain every point that matters; cells out of the query's range are skipped. Points
are sorted by cell, row by row along x. Each point is also stored in the layers below and above its own and, with
`duplicate_rows`, where that pays, in the two neighbouring rows. The 27 cells are then one range of the list instead of
three. Nothing is approximated.
"""

# Postponed annotations are left out: kernels made for a tuning refer to local types.

import functools
from typing import Any

import warp as wp

from aero_planner.device.kernel_tuning import KernelTuning
from aero_planner.device.params import Params
from aero_planner.device.records import Cells, Problem, grid_struct
from aero_planner.device.warp_ops import claim_slots, minimum_over, point_pack, read_point_pack
from aero_planner.kernels.partition import cells_of_thread, farthest, top_speed

wp.set_module_options({"enable_backward": False})

GRID = wp.constant(44)
"""Cells along each side of the grid. The outermost cells hold no points, so that every point has 26 neighbours."""

Row: Any = wp.types.matrix(shape=(44 // 4, 4), dtype=wp.int32)
"""Counts of a row of cells, in groups of four."""

ROUNDING = wp.constant(1.0e-4)
"""Margin for the rounding of positions in the grid [cells]."""

FAR = wp.constant(1.0e18)
"""Coordinate that fills up the last pack [m]."""


@wp.func
def safety_limit(v: wp.vec3, params: Params) -> float:
    """Return the largest clearance that matters for safety, at the speed limit or the velocity v [m]."""
    return params.safe_clearance + params.speed_margin * top_speed(v, params)


@wp.func
def cell_size(v: wp.vec3, params: Params) -> float:
    """Return the width of a cell for a drone of velocity v [m]."""
    return wp.max(params.distance_max, wp.max(safety_limit(v, params), 2.0 * farthest(v, params) / float(GRID - 2)))


@wp.func
def grid_coordinates(x: wp.vec3, center: wp.vec3, size: float) -> wp.vec3:
    """Return the position relative to the corner of the grid, in cells."""
    return (x - center) * (1.0 / size) + wp.vec3(0.5 * float(GRID), 0.5 * float(GRID), 0.5 * float(GRID))


@wp.func
def cell_of_point(x: wp.vec3, center: wp.vec3, size: float):
    """Return the cell that holds a point: its indices along x, y and z."""
    c = grid_coordinates(x, center, size)
    # A point at exactly range_max may round to the cell past the last one.
    last = GRID - 2
    return wp.clamp(int(c[0]), 1, last), wp.clamp(int(c[1]), 1, last), wp.clamp(int(c[2]), 1, last)


@wp.kernel
def count_points(
    # slice of the grid
    worker: int,
    workers: int,
    cells_per_thread: int,
    # problem
    problem: Problem,
    # configuration
    params: wp.array(dtype=Params),
    duplicate_rows: int,
    # in
    cells: Cells,
    # out
    cell_ends: wp.array2d(dtype=int),
):
    """Count the points of each cell in `cell_ends`.

    Launched over [B, threads], see `cells_of_thread`. A worker handles every `workers`-th layer of the grid.
    """
    b, thread = wp.tid()
    center = problem.position[b]
    size = cell_size(problem.velocity[b], params[b])
    first, end = cells_of_thread(thread, 0, 1, cells_per_thread, cells.rows * cells.columns)
    for i in range(first, end):
        if cells.occupied[b, i] != 0:
            cx, cy, cz = cell_of_point(cells.points[b, i], center, size)
            for z in range(cz - 1, cz + 2):
                if workers == 1 or z % workers == worker:
                    for y in range(cy - duplicate_rows, cy + duplicate_rows + 1):
                        wp.atomic_add(cell_ends, b, (z * GRID + y) * GRID + cx, 1)


@wp.kernel
def allocate_rows(
    # slice of the grid
    worker: int,
    workers: int,
    worker_rows: int,
    worker_capacity: int,
    # in and out
    points_used: wp.array2d(dtype=int),
    cell_counts: wp.array2d(dtype=wp.vec4i),
):
    """Assign a range of this worker's part of the list to each row of cells; counts become the begin of each cell.

    `cell_counts` is `cell_ends` in groups of four. The range of a row depends on the order of the threads; the nearest
    distance does not. Launched over [B, rows of the worker, rounded up to whole warps of 32].
    """
    b, i = wp.tid()
    row = Row()
    length = int(0)
    first = ((i // GRID) * workers + worker) * GRID * GRID + (i % GRID) * GRID
    if i < worker_rows:
        # All counts are read before their use, so that a GPU waits for memory once.
        for x in range(GRID // 4):
            row[x] = cell_counts[b, first // 4 + x]
        for x in range(GRID // 4):
            length += row[x, 0] + row[x, 1] + row[x, 2] + row[x, 3]
    cursor = worker * worker_capacity + claim_slots(points_used, worker, b, length)
    if length == 0:
        return
    for x in range(GRID // 4):
        begin = wp.vec4i(cursor, cursor + row[x, 0], cursor + row[x, 0] + row[x, 1], 0)
        begin[3] = begin[2] + row[x, 2]
        cell_counts[b, first // 4 + x] = begin
        cursor = begin[3] + row[x, 3]


@functools.cache
def fill_rows(tuning: KernelTuning) -> wp.Kernel:
    """Return the kernel that lists the points by cell, in packs of `tuning.points_per_pack`."""
    WIDTH = wp.constant(tuning.points_per_pack)

    @wp.kernel(module="unique", enable_backward=False)
    def fill_rows(
        # slice of the grid
        worker: int,
        workers: int,
        worker_capacity: int,
        cells_per_thread: int,
        # problem
        problem: Problem,
        # configuration
        params: wp.array(dtype=Params),
        duplicate_rows: int,
        # in
        cells: Cells,
        points_used: wp.array2d(dtype=int),
        # in and out
        cell_ends: wp.array2d(dtype=int),
        # out
        pack_coordinates: wp.array4d(dtype=float),
    ):
        """Write every point into its cells; `cell_ends` becomes the end of each cell, where the next of the row begins.

        `pack_coordinates` holds the packs of points, shape [B, packs, 3, WIDTH]. Launched over [B, threads], see
        `cells_of_thread`.
        """
        b, thread = wp.tid()
        if thread == 0:
            used = worker * worker_capacity + points_used[worker, b]
            for slot in range(used, (used + WIDTH - 1) // WIDTH * WIDTH):
                pack_coordinates[b, slot // WIDTH, 0, slot % WIDTH] = FAR
        center = problem.position[b]
        size = cell_size(problem.velocity[b], params[b])
        first, end = cells_of_thread(thread, 0, 1, cells_per_thread, cells.rows * cells.columns)
        for i in range(first, end):
            if cells.occupied[b, i] != 0:
                point = cells.points[b, i]
                cx, cy, cz = cell_of_point(point, center, size)
                for z in range(cz - 1, cz + 2):
                    if workers == 1 or z % workers == worker:
                        for y in range(cy - duplicate_rows, cy + duplicate_rows + 1):
                            slot = wp.atomic_add(cell_ends, b, (z * GRID + y) * GRID + cx, 1)
                            pack = slot // WIDTH
                            j = slot % WIDTH
                            pack_coordinates[b, pack, 0, j] = point[0]
                            pack_coordinates[b, pack, 1, j] = point[1]
                            pack_coordinates[b, pack, 2, j] = point[2]

    return fill_rows  # without `set_options`: it must find the very cells that `count_points` counted


@functools.cache
def scan_packs(width: int, threads: int) -> wp.Function:
    """Return the function that compares a position with every `threads`-th pack of `width` points."""
    THREADS, WIDTH = wp.constant(threads), wp.constant(width)
    read_pack = read_point_pack(width)
    is_cuda = width == 4
    Reals: Any = wp.types.vector(length=width, dtype=wp.float32)
    Pack: Any = point_pack(width)

    @wp.func
    def scan_packs(best: Reals, x: wp.vec3, b: int, first: int, end: int, point_packs: wp.array2d(dtype=Pack)) -> Reals:
        """Return the smaller ones of `best` and the squared distances from x to the points of packs [first, end)."""
        for k in range(first, end, THREADS):
            pack = read_pack(point_packs, b, k)
            for j in range(WIDTH):
                dx = pack[0, j] - x[0]
                dy = pack[1, j] - x[1]
                dz = pack[2, j] - x[2]
                d = dx * dx + dy * dy + dz * dz
                # CUDA has an instruction for `min`. On a CPU `min` respects NaN, which takes several.
                if wp.static(is_cuda):
                    best[j] = wp.min(d, best[j])
                else:
                    best[j] = wp.where(d < best[j], d, best[j])
        return best

    return scan_packs


@functools.cache
def smallest(width: int) -> wp.Function:
    """Return the function that finds the smallest of `width` numbers by halving: at most four dependent steps."""
    HALF, QUARTER = wp.constant(width // 2), wp.constant(width // 4)
    REMAINING = wp.constant(max(width // 4, 1))
    Reals: Any = wp.types.vector(length=width, dtype=wp.float32)

    @wp.func
    def smallest(values: Reals) -> float:
        for j in range(HALF):
            values[j] = wp.where(values[j + HALF] < values[j], values[j + HALF], values[j])
        for j in range(QUARTER):
            values[j] = wp.where(values[j + QUARTER] < values[j], values[j + QUARTER], values[j])
        nearest = values[0]
        for j in range(1, REMAINING):
            nearest = wp.where(values[j] < nearest, values[j], nearest)
        return nearest

    return smallest


@functools.cache
def clearance_at(width: int, threads: int) -> wp.Function:
    """Return the function that finds the distance to the nearest point.

    Args:
        width: points per pack.
        threads: neighbouring threads of a warp that query the same position and share its packs.
    """
    minimum, scan, reduce = minimum_over(threads), scan_packs(width, threads), smallest(width)
    WIDTH = wp.constant(width)
    Reals: Any = wp.types.vector(length=width, dtype=wp.float32)
    Grid: Any = grid_struct(width)

    @wp.func
    def clearance_at(x: wp.vec3, limit: float, b: int, thread: int, center: wp.vec3, size: float, grid: Grid) -> float:
        """Return the smaller of `limit` and the distance from x to the nearest point [m].

        `limit` must not exceed `size`, the width of a cell.
        """
        c = grid_coordinates(x, center, size)
        if wp.min(c) < 0.0 or wp.max(c) >= float(GRID):
            return limit
        # The limit in cells.
        limit_x = limit / size + ROUNDING
        limit_y = wp.where(grid.duplicate_rows == 0, limit_x, 0.0)
        best = Reals(limit * limit)
        for y in range(int(wp.max(c[1] - limit_y, 0.0)), int(wp.min(c[1] + limit_y, float(GRID - 1))) + 1):
            row = (int(c[2]) * GRID + y) * GRID
            # The first cell of a row is empty, so its end is the begin of the row.
            first = grid.ends[b, row + int(wp.max(c[0] - limit_x - 1.0, 0.0))]
            last = grid.ends[b, row + int(wp.min(c[0] + limit_x, float(GRID - 1)))]
            if first < last:
                best = scan(best, x, b, first // WIDTH + thread, (last + WIDTH - 1) // WIDTH, grid.packs)
        nearest = minimum(reduce(best))
        return wp.where(nearest < limit * limit, wp.sqrt(nearest), limit)

    return clearance_at


@wp.func
def above_ground(d: float, x: wp.vec3, ground_height: float, params: Params) -> float:
    """Return the smallest of d, the distance from x to the nearest point, the height of x above the ground, and its
    distances from the ends of the band of heights [m].

    `ground_height` is -inf where the ground is unknown.
    """
    d = wp.min(d, wp.max(wp.min(x[2] - params.height_min, params.height_max - x[2]), 0.0))
    return wp.where(params.use_ground != 0, wp.min(d, wp.max(x[2] - ground_height, 0.0)), d)


@wp.func
def goal_between_heights(goal: wp.vec3, ground_height: float, params: Params) -> wp.vec3:
    """Return the place nearest to a goal that is d_max above the ground and within the band of heights [m].

    It is in the middle of a band that is too narrow for that. Beyond, no drone could come nearer to the goal, and would
    look for a way there.
    """
    lowest = params.height_min
    if params.use_ground != 0:
        lowest = wp.max(lowest, ground_height)
    low = lowest + params.distance_max
    high = params.height_max - params.distance_max
    z = wp.where(low < high, wp.clamp(goal[2], low, high), 0.5 * (low + high))
    return wp.vec3(goal[0], goal[1], z)


@wp.func
def query_limit(t: int, steps: int, v: wp.vec3, params: Params) -> float:
    """Return the distance beyond which the clearance of row t of a rollout does not matter [m].

    Rows from `steps` on are probes of the cost-to-go; v is the velocity of the drone.
    """
    if t >= steps:
        return params.distance_min
    return wp.max(params.distance_max, safety_limit(v, params))
