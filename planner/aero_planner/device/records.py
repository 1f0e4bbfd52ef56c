"""Groups of arrays that kernels take as one argument.

Shapes: B drones, M instances, R rows (the M instances, then the candidates that stop), N time steps, F fine cells.
"""

# Postponed annotations are left out: Warp structs need the types themselves.

import functools
from typing import Any

import warp as wp

from aero_planner.device.warp_ops import point_pack


@wp.struct
class CloudSweeps:
    """Sweeps that form the cloud of each drone, S of them, in a ring of P points."""

    points: wp.array2d(dtype=wp.vec3)  # [B, P], world frame [m]
    oldest: wp.array(dtype=int)  # [1], index of the first point of the oldest sweep; the others follow in the ring
    start: wp.array(dtype=int)  # [S], index of the first point of each sweep
    count: wp.array2d(dtype=int)  # [B, S], points of each sweep
    is_ordered: wp.array(dtype=int)  # [S], 1 for a sweep whose points are listed by shell, else 0
    origin: wp.array2d(dtype=wp.vec3)  # [B, S], position of the drone when the sweep arrived, world frame [m]
    time: wp.array2d(dtype=wp.float64)  # [B, S], when it arrived [s]
    center: wp.array2d(dtype=wp.vec3)  # [B, S], centre of the shells, world frame [m]
    reach: wp.array2d(dtype=float)  # [B, S], radius of the first shell [m]
    shell_ends: wp.array2d(dtype=int)  # [B S, COUNTERS], see `kernels.shells`
    # [B, P], points of each sweep by shell, from its start on: x, y, z [m] and the bits of their index in `points`
    ordered_points: wp.array2d(dtype=wp.vec4)


@wp.struct
class Problem:
    """What is given for a plan, world frame, SI units; see `arrays.PlannerInputs`."""

    active: wp.array(dtype=int)  # [B], 0 for drones for which nothing is planned
    time: wp.array(dtype=wp.float64)  # [B], stamp of the state; NaN: 0.02 s after the previous one
    position: wp.array(dtype=wp.vec3)  # [B]
    velocity: wp.array(dtype=wp.vec3)  # [B]
    quaternion: wp.array(dtype=wp.vec4)  # [B], need not be normalised
    acceleration: wp.array(dtype=wp.vec3)  # [B], NaN: unknown
    disturbance: wp.array(dtype=wp.vec3)  # [B], acceleration besides control and gravity; NaN: unknown
    given_goal: wp.array(dtype=wp.vec3)  # [B]
    goal: wp.array(dtype=wp.vec3)  # [B], the place nearest to it at an allowed height, see `goal_between_heights`
    goal_velocity: wp.array(dtype=wp.vec3)  # [B], NaN: zero
    goal_quaternion: wp.array(dtype=wp.vec4)  # [B], NaN: level, with the nose toward the goal
    cloud_age: wp.array(dtype=float)  # [B]
    is_blind: wp.array(dtype=int)  # [B], 1 where the newest sweep shows nothing although something is to be seen
    ground_height: wp.array(dtype=float)  # [B], -inf where it is unknown


@wp.struct
class Start:
    """Where and how a plan begins and what it leads to, world frame, SI units."""

    position: wp.array(dtype=wp.vec3)  # [B], at which the plan takes effect
    velocity: wp.array(dtype=wp.vec3)  # [B]
    quaternion: wp.array(dtype=wp.vec4)  # [B], unit, body to world
    acceleration: wp.array(dtype=wp.vec3)  # [B]
    disturbance: wp.array(dtype=wp.vec3)  # [B], acceleration besides control, gravity and drag that is fed forward
    drag: wp.array(dtype=float)  # [B], deceleration per velocity that is fed forward [1/s]
    command: wp.array(dtype=wp.vec4)  # [B], control commanded
    control: wp.array(dtype=wp.vec4)  # [B], control in effect
    period: wp.array(dtype=float)  # [B], time since the previous plan, taken as that to the next one [s]
    goal_velocity: wp.array(dtype=wp.vec3)  # [B]
    goal_quaternion: wp.array(dtype=wp.vec4)  # [B], unit, body to world
    lookahead: wp.array(dtype=float)  # [B], l [m]
    clip_guides: wp.array(dtype=int)  # [B], 1 where guides end before what their cells measured


@wp.struct
class Cells:
    """Fine cells of the spherical partition; cell i is in row i // columns and column i % columns."""

    rows: int
    columns: int
    directions: wp.array(dtype=wp.vec3)  # [F], unit, of the cell's centre, body frame
    range: wp.array2d(dtype=float)  # [B, F], r_ij [m]; the maximum range where the cell is empty
    occupied: wp.array2d(dtype=int)  # [B, F], 1 where the cell holds a point, 2 where a surface continues, else 0
    points: wp.array2d(dtype=wp.vec3)  # [B, F], nearest point of each occupied cell, world frame [m]


@functools.cache
def grid_struct(width: int) -> Any:
    """Return the struct of the grid of points for clearance queries, with `width` points per pack."""
    Pack: Any = point_pack(width)

    @wp.struct
    class Grid:
        """Points sorted into cells, see `kernels.clearance`."""

        duplicate_rows: int  # 1 if each point is stored in the neighbouring rows as well
        ends: wp.array2d(dtype=int)  # [B, G], end of each cell in the list of points
        packs: wp.array2d(dtype=Pack)  # [B, V], points, world frame [m]

    return Grid


@wp.struct
class GuideSet:
    """Guides of all rows, world frame, SI units."""

    initial_endpoints: wp.array2d(dtype=wp.vec3)  # [B, R]
    anchors: wp.array2d(dtype=wp.vec3)  # [B, R]
    coefficients: wp.array3d(dtype=wp.vec3)  # [B, R, 6]
    positions: wp.array3d(dtype=wp.vec3)  # [B, R, N + 1]


@wp.struct
class Rollouts:
    """Stage II rollouts of all rows, world frame, SI units."""

    controls: wp.array3d(dtype=wp.vec4)  # [B, R, N]
    positions: wp.array3d(dtype=wp.vec3)  # [B, R, N + 1]
    velocities: wp.array3d(dtype=wp.vec3)  # [B, R, N + 1]
    quaternions: wp.array3d(dtype=wp.vec4)  # [B, R, N + 1], body to world


@wp.struct
class Scores:
    """Costs and clearances of all rows."""

    goal_cost: wp.array2d(dtype=float)  # [B, R], J_goal
    collision_cost: wp.array2d(dtype=float)  # [B, R], J_col
    stage2_cost: wp.array2d(dtype=float)  # [B, R], S2
    clearance: wp.array3d(dtype=float)  # [B, R, N], after each control, at most d_max [m]
    # Of Q positions, which are N states and the probes of the cost-to-go, and of the start, less the speed margin:
    state_clearance: wp.array3d(dtype=float)  # [B, R, Q + 1], from all obstacles [m]
    static_clearance: wp.array3d(dtype=float)  # [B, R, Q + 1], from static ones [m]
    # [B, R], least clearance from all obstacles, for which dynamic ones that are near at the start count as farther,
    # and from static ones [m]
    least_clearance: wp.array2d(dtype=wp.vec2)


@wp.struct
class Choice:
    """What was selected, [B] each."""

    best: wp.array(dtype=int)  # instance to fly
    status: wp.array(dtype=int)  # `PlanStatus`
    replaced: wp.array(dtype=int)  # instance that a candidate that stops has replaced, or -1
    flown: wp.array(dtype=int)  # row that is flown


@wp.struct
class PreviousPlan:
    """What a plan leaves to the next one."""

    tick: wp.array(dtype=int)  # [B], number of plans so far
    time: wp.array(dtype=wp.float64)  # [B], stamp [s], NaN where there is no previous plan
    controls: wp.array2d(dtype=wp.vec4)  # [B, N], flown
    start_control: wp.array(dtype=wp.vec4)  # [B], control in effect at its start
    end: wp.array(dtype=wp.vec3)  # [B], final position of the rollout, world frame [m]
    blind_time: wp.array(dtype=float)  # [B], for how long sweeps had shown nothing [s]


def bundle(struct: Any, **arrays: Any) -> Any:
    """Return an instance of a Warp struct with its arrays and numbers."""
    instance = struct()
    for name, array in arrays.items():
        setattr(instance, name, array)
    return instance
