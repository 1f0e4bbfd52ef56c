"""Spherical partition of the cloud: fine ranges, coarse safe directions and the filtered cloud.

A direction is d = (cos b cos a, cos b sin a, sin b) with azimuth a and elevation b in the body frame. Fine cells have
equal angles; row 0 points straight down, column 0 backward (a = -180 deg). A coarse cell pools fine_cells x fine_cells
fine cells.
"""

# Postponed annotations are left out: functions made for a tuning refer to local types.

import functools

import warp as wp

from aero_planner.composition import Composition
from aero_planner.config.planner_config import COARSE_COLUMNS, COARSE_ROWS
from aero_planner.device.kernel_tuning import KernelTuning
from aero_planner.device.params import Params
from aero_planner.device.records import Cells, CloudSweeps, Problem
from aero_planner.device.rotations import near_atan2, quat_rotate
from aero_planner.device.warp_ops import add_count, minimum_over, near_root, read_key, read_vector
from aero_planner.kernels.shells import SHELLS, last_shell

wp.set_module_options({"enable_backward": False})

EMPTY = wp.constant(wp.uint64(0))
"""Key of a fine cell that holds no point: less than all others, and zero, so that a memory fill resets the keys."""


ROWS, COLUMNS = wp.constant(COARSE_ROWS), wp.constant(COARSE_COLUMNS)
"""Rows and columns of coarse cells."""


@wp.func
def longest_lookahead(params: Params) -> float:
    """Return the longest look-ahead distance, which grows with the speed limit [m]."""
    return wp.max(params.lookahead, params.lookahead_time * params.speed_limit)


@wp.func
def top_speed(v: wp.vec3, params: Params) -> float:
    """Return the speed limit, or the speed of a drone that is faster, since its limit was lowered in flight [m/s]."""
    return wp.max(params.speed_limit, wp.length(v))


@wp.func
def farthest(v: wp.vec3, params: Params) -> float:
    """Return the range beyond which a drone of velocity v ignores points [m].

    It grows with the speed as the look-ahead does: a drone must see as far as it needs to stop.
    """
    return wp.max(params.range_max, 2.0 * params.lookahead_time * top_speed(v, params))


@wp.func
def cell_of_direction(d: wp.vec3, rows: int, columns: int):
    """Return row and column of the cell that contains the direction d, which need not be a unit vector."""
    azimuth = wp.atan2(d[1], d[0])
    elevation = wp.atan2(d[2], wp.sqrt(d[0] * d[0] + d[1] * d[1]))
    row = int(wp.floor(elevation * (float(rows) / wp.PI) + 0.5 * float(rows)))
    column = int(wp.floor(azimuth * (0.5 * float(columns) / wp.PI) + 0.5 * float(columns)))
    # a = +180 deg is the same as a = -180 deg; b = +90 deg belongs to the top row.
    return wp.clamp(row, 0, rows - 1), (column + columns) % columns


@wp.func
def cell_direction(row: int, column: int, rows: int, columns: int) -> wp.vec3:
    """Return the unit direction of a cell's centre."""
    azimuth = ((float(column) + 0.5) / float(columns) - 0.5) * 2.0 * wp.PI
    elevation = ((float(row) + 0.5) / float(rows) - 0.5) * wp.PI
    c = wp.cos(elevation)
    return wp.vec3(c * wp.cos(azimuth), c * wp.sin(azimuth), wp.sin(elevation))


_SAME_COSINE = wp.constant(1.0e-6)
"""Difference between the cosines of directions that count as equal."""
NEAR_EDGE = wp.constant(-1)
OUT_OF_RANGE = wp.constant(-2)
"""Markers that `scatter_points` stores instead of a cell number."""


@functools.cache
def scatter_points(tuning: KernelTuning, composition: Composition) -> wp.Kernel:
    """Return the kernel that finds r_ij. Each thread handles `tuning.points_per_thread` points at once."""
    Views, is_ghost = composition.Views, composition.hooks.ghost
    WIDTH = wp.constant(tuning.points_per_thread)
    # Those that are left of one group, and the next group.
    Reals = wp.types.vector(length=2 * tuning.points_per_thread, dtype=wp.float32)
    Integers = wp.types.vector(length=2 * tuning.points_per_thread, dtype=wp.int32)

    # Limits the registers so that a multiprocessor holds four blocks; without the limit it holds two.
    @wp.kernel(module="unique", enable_backward=False, launch_bounds=(256, 4))
    def scatter_points(
        # share of the points
        worker: int,
        stride: int,
        # problem
        problem: Problem,
        cloud: CloudSweeps,
        # configuration
        params: wp.array(dtype=Params),
        rows: int,
        columns: int,
        # in
        views: Views,
        # out
        cell_keys: wp.array3d(dtype=wp.uint64),
        worker_dropped: wp.array2d(dtype=int),
    ):
        """Find r_ij by a maximum over packed keys.

        The upper half of a key is the range, the lower half the place of the point in the cloud, both inverted: of the
        nearest points the first one has the largest key. Ghost points are left out. Of an ordered sweep only the shells
        within reach are read. Of others most points are out of range; they are skipped before the cells of WIDTH points
        are computed at once.
        Workers run at the same time, each on its own keys.
        Launched over [B, sweeps, threads per sweep]. A thread handles every `stride`-th group of WIDTH points.
        """
        b, sweep, thread = wp.tid()
        if problem.active[b] == 0:
            return
        count = cloud.count[b, sweep]
        if count == 0:
            return
        first = cloud.start[sweep]
        oldest = cloud.oldest[0]
        ordered = cloud.is_ordered[sweep] != 0
        origin = problem.position[b]
        range_max = farthest(problem.velocity[b], params[b])
        if ordered:
            counters = b * cloud.start.shape[0] + sweep
            last = last_shell(origin, cloud.center[b, sweep], range_max, cloud.reach[b, sweep])
            count = cloud.shell_ends[counters, last]
            if worker + thread == 0:
                wp.atomic_add(worker_dropped, worker, b, cloud.shell_ends[counters, SHELLS])
        groups = (count + WIDTH - 1) // WIDTH
        if worker + thread >= groups:
            return
        q = wp.normalize(problem.quaternion[b])
        forward = quat_rotate(q, wp.vec3(1.0, 0.0, 0.0))
        left = quat_rotate(q, wp.vec3(0.0, 1.0, 0.0))
        up = quat_rotate(q, wp.vec3(0.0, 0.0, 1.0))
        range_min = params[b].range_min
        range_squared = 1.0001 * range_max * range_max  # with a margin for rounding
        dx = Reals()
        dy = Reals()
        dz = Reals()
        indices = Integers()
        range_bits = Integers()
        cell_of = Integers()
        waiting = int(0)
        for group in range(worker + thread, groups, stride):
            if wp.static(tuning.is_cuda):
                waiting = int(0)  # it is 0 already; a constant index keeps the point in registers
            start = group * WIDTH
            not_finite = int(0)
            for j in range(wp.min(WIDTH, count - start)):
                index = first + start + j
                point = wp.vec3()
                if ordered:
                    entry = read_vector(cloud.ordered_points, b, index)
                    point = wp.vec3(entry[0], entry[1], entry[2])
                    index = wp.cast(entry[3], wp.int32)
                else:
                    point = cloud.points[b, index]
                d = point - origin
                indices[waiting] = index
                dx[waiting] = d[0]
                dy[waiting] = d[1]
                dz[waiting] = d[2]
                if ordered:
                    waiting += 1
                else:
                    waiting += wp.where(wp.dot(d, d) <= range_squared, 1, 0)
                    # d - d is NaN for a component that is not finite; the squared range may overflow for finite points.
                    not_finite += wp.where((d[0] - d[0]) + (d[1] - d[1]) + (d[2] - d[2]) == 0.0, 0, 1)
            if not ordered:
                add_count(worker_dropped, worker, b, not_finite)
            least = wp.where(group + stride < groups, WIDTH, 1)
            while waiting >= least:
                present = wp.min(WIDTH, waiting)
                for j in range(WIDTH):
                    d = wp.vec3(dx[j], dy[j], dz[j])
                    x = wp.dot(forward, d)
                    y = wp.dot(left, d)
                    z = wp.dot(up, d)
                    r = wp.sqrt(wp.dot(d, d))
                    row = (near_atan2(z, near_root(x * x + y * y)) * (1.0 / wp.PI) + 0.5) * float(rows)
                    column = (near_atan2(y, x) * (0.5 / wp.PI) + 0.5) * float(columns)
                    off_center = wp.max(wp.abs(row - wp.floor(row) - 0.5), wp.abs(column - wp.floor(column) - 0.5))
                    cell = int(wp.floor(row)) * columns + int(wp.floor(column))
                    cell = wp.where(off_center > 0.4999, NEAR_EDGE, cell)
                    cell_of[j] = wp.where(r >= range_min, wp.where(r <= range_max, cell, OUT_OF_RANGE), OUT_OF_RANGE)
                    range_bits[j] = wp.cast(r, wp.int32)
                for j in range(present):
                    cell = cell_of[j]
                    if cell >= NEAR_EDGE:
                        if cell == NEAR_EDGE:
                            d = wp.vec3(dx[j], dy[j], dz[j])
                            body = wp.vec3(wp.dot(forward, d), wp.dot(left, d), wp.dot(up, d))
                            row_of, column_of = cell_of_direction(body, rows, columns)
                            cell = row_of * columns + column_of
                        place = indices[j] - oldest
                        if place < 0:
                            place += cloud.points.shape[1]
                        # The bits of non-negative floats have the order of the floats.
                        key = ~((wp.uint64(wp.uint32(range_bits[j])) << wp.uint64(32)) | wp.uint64(place))
                        if key > read_key(cell_keys, worker, b, cell):
                            point = origin + wp.vec3(dx[j], dy[j], dz[j])
                            if is_ghost(b, point, cloud.time[b, sweep], views, params[b]) == 0:
                                wp.atomic_max(cell_keys, worker, b, cell, key)
                waiting -= present
                if wp.static(not tuning.is_cuda):
                    for j in range(waiting):
                        indices[j] = indices[present + j]
                        dx[j] = dx[present + j]
                        dy[j] = dy[present + j]
                        dz[j] = dz[present + j]

    return scatter_points


@wp.func
def cells_of_thread(thread: int, worker: int, workers: int, width: int, cells: int):
    """Return the first cell of a thread and the end of its cells; workers take turns."""
    first = (thread * workers + worker) * width
    return first, wp.min(first + width, cells)


@wp.kernel
def finish_fine_cells(
    # share of the cells
    worker: int,
    workers: int,
    cells_per_thread: int,
    # problem
    problem: Problem,
    cloud: CloudSweeps,
    # configuration
    params: wp.array(dtype=Params),
    # in
    cell_keys: wp.array3d(dtype=wp.uint64),
    # in and reset
    worker_dropped: wp.array2d(dtype=int),
    # out
    cells: Cells,
    dropped_points: wp.array(dtype=int),
):
    """Merge the keys and counters of all workers into ranges, filtered cloud and the number of dropped points.

    Counters are reset for the next plan. Launched over [B, threads], see `cells_of_thread`.
    """
    b, thread = wp.tid()
    first, end = cells_of_thread(thread, worker, workers, cells_per_thread, cells.rows * cells.columns)
    if first == 0:
        count = int(0)
        for scanned in range(cell_keys.shape[0]):
            count += worker_dropped[scanned, b]
            worker_dropped[scanned, b] = 0
        dropped_points[b] = count
    empty_range = farthest(problem.velocity[b], params[b])
    for cell in range(first, end):
        key = EMPTY
        for scanned in range(cell_keys.shape[0]):
            key = wp.max(key, cell_keys[scanned, b, cell])
        if key == EMPTY:
            cells.range[b, cell] = empty_range
            cells.occupied[b, cell] = 0
        else:
            cells.range[b, cell] = wp.cast(wp.uint32(~key >> wp.uint64(32)), float)
            cells.occupied[b, cell] = 1
            index = int(~key & wp.uint64(0xFFFFFFFF)) + cloud.oldest[0]
            if index >= cloud.points.shape[1]:
                index -= cloud.points.shape[1]
            cells.points[b, cell] = cloud.points[b, index]


@wp.kernel
def fill_directions(rows: int, columns: int, directions: wp.array(dtype=wp.vec3)):
    """Write the directions of the centres of all fine cells. Launched over [F]."""
    i = wp.tid()
    directions[i] = cell_direction(i // columns, i % columns, rows, columns)


@functools.cache
def safest_fine_cell(lanes: int) -> wp.Function:
    """Return the function that finds the safe direction of a coarse cell, which `lanes` lanes of a warp share."""
    width = max(16 // lanes, 2)  # cells that a lane reads together, so that a GPU waits for memory once for all of them
    LANES, WIDTH = wp.constant(lanes), wp.constant(width)
    minimum = minimum_over(lanes)
    Reals = wp.types.vector(length=width, dtype=wp.float32)

    @wp.func
    def safest_fine_cell(cells: Cells, b: int, lane: int, coarse_row: int, coarse_column: int, toward: wp.vec3):
        """Return the largest range in a coarse cell and its direction; among equal ranges that nearest to `toward`."""
        fine_cells = cells.rows // ROWS
        best_range = float(-1.0)
        best_cosine = float(-2.0)
        best_cell = int(0)
        r = Reals()
        cosine = Reals()
        count = fine_cells * fine_cells
        for first in range(lane, count, LANES * WIDTH):
            for k in range(WIDTH):
                # Past the end the first cell is read again, which changes nothing.
                i = wp.where(first + k * LANES < count, first + k * LANES, first)
                row = coarse_row * fine_cells + i // fine_cells
                cell = row * cells.columns + coarse_column * fine_cells + i % fine_cells
                r[k] = cells.range[b, cell]
                cosine[k] = wp.dot(cells.directions[cell], toward)
            for k in range(WIDTH):
                # The margin makes the first of several equally near cells win in spite of rounding.
                if r[k] > best_range or (r[k] == best_range and cosine[k] > best_cosine + _SAME_COSINE):
                    best_range = r[k]
                    best_cosine = cosine[k]
                    best_cell = first + k * LANES
        if wp.static(lanes > 1):
            largest = -minimum(-best_range)
            nearest = -minimum(wp.where(best_range == largest, -best_cosine, wp.INF))
            is_best = best_range == largest and best_cosine >= nearest - _SAME_COSINE
            best_cell = int(minimum(wp.where(is_best, float(best_cell), wp.INF)))
            best_range = largest
        row = coarse_row * fine_cells + best_cell // fine_cells
        best_direction = cells.directions[row * cells.columns + coarse_column * fine_cells + best_cell % fine_cells]
        return best_range, best_direction

    return safest_fine_cell


_safest = safest_fine_cell(1)


@wp.kernel
def pool_coarse(
    # in
    cells: Cells,
    initial_directions: wp.array2d(dtype=wp.vec3),
    # out
    safe_range: wp.array2d(dtype=float),
    safe_direction: wp.array2d(dtype=wp.vec3),
):
    """Find the safe range and direction of each coarse cell. Launched over [B, coarse cells].

    Ties are broken toward the first anchor in the cell, or toward the centre of a cell without an anchor.
    """
    b, cell = wp.tid()
    coarse_row = cell // COLUMNS
    coarse_column = cell % COLUMNS
    toward = cell_direction(coarse_row, coarse_column, ROWS, COLUMNS)
    anchor_count = initial_directions.shape[1]
    for reverse in range(anchor_count):
        d = initial_directions[b, anchor_count - 1 - reverse]
        row, column = cell_of_direction(d, ROWS, COLUMNS)
        if row == coarse_row and column == coarse_column:
            toward = d
    best_range, best_direction = _safest(cells, b, 0, coarse_row, coarse_column, toward)
    safe_range[b, cell] = best_range
    safe_direction[b, cell] = best_direction
