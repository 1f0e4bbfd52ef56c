"""Surfaces continued past the edges of the field of view: space that was not seen is not free.

The field of view is that of one sensor or of two, each between two elevations and as wide around a middle azimuth in
the body frame. Beside it, space is unknown from `UNKNOWN_RANGE` on, as if a surface were there.

What is seen at the lower edge of the field of view continues straight down, and what is seen at its upper edge straight
up. The search runs along vertical half-planes through the drone, sampled like the fine cells: rows of equal elevation
and columns of equal azimuth, but in the world frame.
"""

# Postponed annotations are left out: kernels made for a tuning refer to local types.

import functools

import warp as wp

from aero_planner.device.kernel_tuning import KernelTuning
from aero_planner.device.params import Params
from aero_planner.device.records import Cells, PreviousPlan, Problem
from aero_planner.device.rotations import near_atan2, quat_inverse_rotate, quat_rotate
from aero_planner.kernels.partition import cells_of_thread, farthest
from aero_planner.kernels.prediction import time_since_plan
from aero_planner.stages.unseen_space.view import edges_at, edges_of_view, is_beside, is_narrow

wp.set_module_options({"enable_backward": False})

_EDGE_ROWS = wp.constant(2.0)
"""Rows inside the field of view in which a surface is at its edge; beam patterns do not fill the last one."""
UNKNOWN_RANGE = wp.constant(2.0)
"""Distance from which space beside the view is unknown [m]. Nearer, the drone has seen it on its way."""
_LEAST_FLAT = wp.constant(0.2)
"""Cosine of the steepest elevation to which surfaces are continued."""
_SAME_SURFACE = wp.constant(0.1)
"""Difference in horizontal distance from one row to the next within a surface, which may lean [m]."""
CONTINUED = wp.constant(2)
"""Value of `occupied` in cells into which a surface is continued."""
READ_ROWS = wp.constant(16)
"""Cells of a column that are read together, so that a GPU waits for memory once for all of them."""
_Surfaces = wp.types.matrix(shape=(READ_ROWS, 2), dtype=wp.float32)


@wp.func
def lagged_attitude(q: wp.vec4, before: wp.vec4, since: float, lag: float) -> wp.vec4:
    """Return an attitude that follows q and is older by `lag` [s] on average; `before` is that of `since` [s] ago."""
    if not since >= 0.0:  # also if there is no plan before
        return q
    nearest = wp.where(wp.dot(before, q) < 0.0, -before, before)
    share = since / wp.max(since + lag, 1.0e-6)
    return wp.normalize(nearest + share * (q - nearest))


@wp.kernel
def follow_attitude(
    # problem
    problem: Problem,
    # configuration
    params: wp.array(dtype=Params),
    # in
    previous: PreviousPlan,
    # in and out
    view_quaternion: wp.array(dtype=wp.vec4),
):
    """Let `view_quaternion` follow the attitude with the lag `view_age`. Launched over [B]."""
    b = wp.tid()
    since = time_since_plan(b, problem.time[b], previous, params[b])
    q = wp.normalize(problem.quaternion[b])
    view_quaternion[b] = lagged_attitude(q, view_quaternion[b], since, params[b].view_age)


@wp.func
def near_cell(d: wp.vec3, rows: int, columns: int) -> int:
    """Return the number of the cell that contains the direction d; rounding may decide at its borders."""
    row = int((near_atan2(d[2], wp.sqrt(d[0] * d[0] + d[1] * d[1])) / wp.PI + 0.5) * float(rows))
    column = int((near_atan2(d[1], d[0]) / (2.0 * wp.PI) + 0.5) * float(columns))
    return wp.clamp(row, 0, rows - 1) * columns + wp.clamp(column, 0, columns - 1)


@functools.cache
def rotate_directions(tuning: KernelTuning) -> wp.Function:
    """Return the function that rotates the directions of `tuning.cells_per_thread` cells.

    On a CPU, LLVM turns its second loop into vector instructions, since nothing is read from memory in it.
    """
    WIDTH = wp.constant(tuning.cells_per_thread)
    Reals = wp.types.vector(length=tuning.cells_per_thread, dtype=wp.float32)
    Integers = wp.types.vector(length=tuning.cells_per_thread, dtype=wp.int32)

    @wp.func
    def rotate_directions(first: int, q: wp.vec4, fine: Cells):
        """Return x, y and z of the directions of cells from `first` on, rotated by q, and the cells that hold them."""
        dx = Reals()
        dy = Reals()
        dz = Reals()
        cells = Integers()
        for j in range(WIDTH):
            d = fine.directions[wp.min(first + j, fine.rows * fine.columns - 1)]
            dx[j] = d[0]
            dy[j] = d[1]
            dz[j] = d[2]
        for j in range(WIDTH):
            d = quat_rotate(q, wp.vec3(dx[j], dy[j], dz[j]))
            dx[j] = d[0]
            dy[j] = d[1]
            dz[j] = d[2]
            cells[j] = near_cell(d, fine.rows, fine.columns)
        return dx, dy, dz, cells

    return rotate_directions


@functools.cache
def find_edges(tuning: KernelTuning) -> wp.Kernel:
    """Return the kernel that finds surfaces at the edges of the view, for `tuning.cells_per_thread` cells at once."""
    WIDTH = wp.constant(tuning.cells_per_thread)
    rotate = rotate_directions(tuning)

    @wp.kernel(module="unique", enable_backward=False)
    def find_edges(
        # share of the cells
        worker: int,
        workers: int,
        # problem
        problem: Problem,
        # configuration
        params: wp.array(dtype=Params),
        # in
        view_quaternion: wp.array(dtype=wp.vec4),
        cells: Cells,
        # out
        surfaces: wp.array3d(dtype=wp.vec2),
    ):
        """Find the surfaces at the lower (0) and the upper (1) edge of the field of view, and beyond.

        `surfaces` are the horizontal distance, infinite without a surface, and the height above the drone [m], for each
        cell of the world frame, at its `place_of_cell`. A surface counts if it was at the edge `view_age` ago, at the
        attitude `view_quaternion`: what has come into view since may not have been measured yet. Launched over
        [B, threads], see `cells_of_thread`.
        """
        b, thread = wp.tid()
        c = params[b]
        if c.continuation <= 0.0:
            return
        rows = cells.rows
        columns = cells.columns
        q = wp.normalize(problem.quaternion[b])
        origin = problem.position[b]
        moved = c.view_age * problem.velocity[b]
        height = wp.PI / float(rows)
        margin = _EDGE_ROWS * height
        edges = edges_of_view(c)
        narrow = is_narrow(c)
        first, end = cells_of_thread(thread, worker, workers, WIDTH, rows * columns)
        _, _, _, sources = rotate(first, wp.vec4(q[0], -q[1], -q[2], -q[3]), cells)
        for j in range(end - first):
            lower = wp.vec2(wp.INF, 0.0)
            upper = lower
            source = sources[j]
            if cells.occupied[b, source] == 1:
                offset = cells.points[b, source] - origin
                surface = wp.vec2(wp.sqrt(offset[0] * offset[0] + offset[1] * offset[1]), offset[2])
                d = quat_inverse_rotate(view_quaternion[b], offset + moved)
                then = near_atan2(d[2], wp.sqrt(d[0] * d[0] + d[1] * d[1]))
                now = (float(source // columns) + 0.5) * height - 0.5 * wp.PI
                edges_now = edges
                edges_then = edges
                if narrow:
                    edges_now = edges_at((float(source % columns) + 0.5) * height - wp.PI, edges, c)
                    edges_then = edges_at(near_atan2(d[1], d[0]), edges, c)
                if now <= wp.radians(edges_now[0]) + margin or then <= wp.radians(edges_then[0]) + margin:
                    lower = surface
                if now >= wp.radians(edges_now[1]) - margin or then >= wp.radians(edges_then[1]) - margin:
                    upper = surface
            surfaces[b, 0, place_of_cell(first + j, 0, rows, columns)] = lower
            surfaces[b, 1, place_of_cell(first + j, 1, rows, columns)] = upper

    return tuning.set_options(find_edges)


@wp.func
def place_of_cell(cell: int, side: int, rows: int, columns: int) -> int:
    """Return the place of a cell in the order of the search: down from the top (0) or up from the bottom (1)."""
    return wp.where(side == 0, rows * columns - 1 - cell, cell)


@wp.kernel
def find_nearest_surfaces(
    # share of the columns
    worker: int,
    workers: int,
    # configuration
    params: wp.array(dtype=Params),
    rows: int,
    columns: int,
    # in and out
    surfaces: wp.array3d(dtype=wp.vec2),
):
    """Replace the surface of each cell by the nearest one above it (0) or below it (1), of which the last part counts.

    `surfaces` has room for whole multiples of READ_ROWS rows. Launched over [B, 2, columns / workers, rounded up]; a
    thread walks down a column, or up.
    """
    b, side, i = wp.tid()
    column = i * workers + worker
    if column >= columns or params[b].continuation <= 0.0:
        return
    nearest = wp.vec2(wp.INF, 0.0)
    read = _Surfaces()
    for first in range(0, rows, READ_ROWS):
        for j in range(READ_ROWS):
            read[j] = surfaces[b, side, (first + j) * columns + column]
        for j in range(READ_ROWS):
            if read[j, 0] < nearest[0] + _SAME_SURFACE:
                nearest = wp.vec2(read[j, 0], read[j, 1])
            surfaces[b, side, (first + j) * columns + column] = nearest


@functools.cache
def continue_surfaces(tuning: KernelTuning) -> wp.Kernel:
    """Return the kernel that fills cells with continued surfaces, `tuning.cells_per_thread` at once."""
    WIDTH = wp.constant(tuning.cells_per_thread)
    rotate = rotate_directions(tuning)

    @wp.kernel(module="unique", enable_backward=False)
    def continue_surfaces(
        # share of the cells
        worker: int,
        workers: int,
        # problem
        problem: Problem,
        # configuration
        params: wp.array(dtype=Params),
        # in
        view_quaternion: wp.array(dtype=wp.vec4),
        surfaces: wp.array3d(dtype=wp.vec2),
        # in and out
        cells: Cells,
    ):
        """Fill empty cells with the continuation of a surface, by at most `continuation`, or with unknown space.

        Filled cells are marked as CONTINUED. A cell is beside the view if it was `view_age` ago, at the attitude
        `view_quaternion`. Launched over [B, threads], see `cells_of_thread`.
        """
        b, thread = wp.tid()
        c = params[b]
        if c.continuation <= 0.0:
            return
        rows = cells.rows
        columns = cells.columns
        q = wp.normalize(problem.quaternion[b])
        origin = problem.position[b]
        range_max = farthest(problem.velocity[b], c)
        edges = edges_of_view(c)
        middle = 0.5 * wp.radians(edges[0] + edges[1])
        narrow = is_narrow(c)
        first, end = cells_of_thread(thread, worker, workers, WIDTH, rows * columns)
        dx, dy, dz, sources = rotate(first, q, cells)
        for j in range(end - first):
            cell = first + j
            elevation = (float(cell // columns) + 0.5) * (wp.PI / float(rows)) - 0.5 * wp.PI
            side = wp.where(elevation > middle, 1, 0)
            flat = wp.sqrt(dx[j] * dx[j] + dy[j] * dy[j])
            if flat >= _LEAST_FLAT:
                surface = surfaces[b, side, place_of_cell(sources[j], side, rows, columns)]
                distance = surface[0] / flat
                depth = surface[1] - distance * dz[j]
                is_near = distance <= range_max and wp.where(side == 0, depth, -depth) <= c.continuation
                if narrow:
                    then = quat_inverse_rotate(view_quaternion[b], wp.vec3(dx[j], dy[j], dz[j]))
                    if is_beside(near_atan2(then[1], then[0]), c):
                        distance = wp.min(wp.where(is_near, distance, range_max), UNKNOWN_RANGE)
                        is_near = True
                if is_near and cells.occupied[b, cell] != 1:
                    cells.range[b, cell] = distance
                    cells.points[b, cell] = origin + distance * wp.vec3(dx[j], dy[j], dz[j])
                    cells.occupied[b, cell] = CONTINUED

    return tuning.set_options(continue_surfaces)
