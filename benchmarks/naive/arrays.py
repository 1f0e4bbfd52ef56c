"""Device arrays and sizes of the naive planner, in one struct that every kernel takes.

Shapes: B drones, M instances, R = M + BRAKING_CANDIDATES rows, K samples, N steps, F fine cells, C coarse cells.
Instance m of drone b has the index b M + m in arrays of Stage I, and b R + m in those of Stage II.
"""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import warp as wp

from aero_planner import Planner
from aero_planner.arrays import fine_shape
from aero_planner.device.params import Params
from benchmarks.naive.model import PROBES

BRAKING_CANDIDATES = wp.constant(5)
"""Braking candidates: straight ahead, and turned to both sides."""


@wp.struct
class Arrays:
    """Inputs, intermediate results and results; lengths in metres, world frame, quaternions w x y z."""

    # Sizes and indices; -1 where there is no such candidate
    fine_cells: int
    coarse_rows: int
    coarse_columns: int
    anchor_rows: int
    anchor_columns: int
    previous_index: int
    brake_index: int

    # The planner's own arrays: inputs [B], cloud [B, P] and live parameters [B]
    time: wp.array(dtype=wp.float64)
    position: wp.array(dtype=wp.vec3)
    velocity: wp.array(dtype=wp.vec3)
    quaternion: wp.array(dtype=wp.vec4)
    acceleration: wp.array(dtype=wp.vec3)
    disturbance: wp.array(dtype=wp.vec3)
    goal_position: wp.array(dtype=wp.vec3)
    goal_velocity: wp.array(dtype=wp.vec3)
    goal_quaternion: wp.array(dtype=wp.vec4)
    cloud_age: wp.array(dtype=float)
    ground_height: wp.array(dtype=float)
    point_count: wp.array(dtype=int)
    points: wp.array2d(dtype=wp.vec3)
    params: wp.array(dtype=Params)

    # History [B] and noise [B M, K, N]
    tick: wp.array(dtype=int)
    previous_controls: wp.array2d(dtype=wp.vec4)
    previous_start_control: wp.array(dtype=wp.vec4)
    previous_end: wp.array(dtype=wp.vec3)
    previous_waypoint: wp.array(dtype=wp.vec3)
    previous_time: wp.array(dtype=wp.float64)
    noise: wp.array3d(dtype=wp.vec4)

    # Completed attitude, command and control in effect, and goal [B], partition [B, F] and [B, C], directions of the
    # anchors in the body frame
    q0: wp.array(dtype=wp.vec4)
    command: wp.array(dtype=wp.vec4)
    control: wp.array(dtype=wp.vec4)
    v_goal: wp.array(dtype=wp.vec3)
    q_goal: wp.array(dtype=wp.vec4)
    keys: wp.array2d(dtype=wp.uint64)
    dropped: wp.array(dtype=int)
    fine_range: wp.array2d(dtype=float)
    count: wp.array(dtype=int)
    filtered: wp.array2d(dtype=wp.vec3)
    reach: wp.array(dtype=float)
    direction: wp.array2d(dtype=wp.vec3)
    safe_range: wp.array2d(dtype=float)
    safe_direction: wp.array2d(dtype=wp.vec3)

    # Guides [B, R, ..]; time since the previous plan [s], or -1 if there is none to continue from
    elapsed: wp.array(dtype=float)
    anchor: wp.array2d(dtype=wp.vec3)
    coefficient: wp.array3d(dtype=wp.vec3)
    guide: wp.array3d(dtype=wp.vec3)
    waypoint: wp.array2d(dtype=wp.vec3)
    nominal: wp.array3d(dtype=wp.vec4)

    # Stage I [B M, K, ..]; rows of positions are the states, then the probes
    sample_controls: wp.array3d(dtype=wp.vec4)
    sample_positions: wp.array3d(dtype=wp.vec3)
    sample_distance: wp.array3d(dtype=float)
    cost: wp.array2d(dtype=float)
    weight: wp.array2d(dtype=float)

    # Stage II [B, R, ..]; positions [B R, 1, ..] have the midpoints between states after the probes
    controls: wp.array3d(dtype=wp.vec4)
    states: wp.array3d(dtype=wp.vec3)
    positions: wp.array3d(dtype=wp.vec3)
    distance: wp.array3d(dtype=float)
    J_goal: wp.array2d(dtype=float)
    J_speed: wp.array2d(dtype=float)
    J_col: wp.array2d(dtype=float)
    S2: wp.array2d(dtype=float)
    nearest: wp.array2d(dtype=float)
    best: wp.array(dtype=int)
    status: wp.array(dtype=int)
    source: wp.array(dtype=int)


def allocate(planner: Planner) -> tuple[Any, tuple[str, ...]]:
    """Return `Arrays` for a planner, and the names of the arrays that are not the planner's own."""
    config = planner.config
    part, kinds = config.partition, config.kinds
    B, M, N, K = planner.inputs.position.shape[0], len(kinds), config.sampling.steps, config.sampling.samples
    R, (rows, columns) = M + BRAKING_CANDIDATES, fine_shape(config)
    F, C = rows * columns, part.coarse_rows * part.coarse_columns
    shapes: list[tuple[tuple[int, ...], str]] = [
        (
            (B,),
            "tick previous_end previous_start_control previous_waypoint previous_time q0 command control v_goal q_goal "
            "dropped count reach elapsed",
        ),
        ((B,), "best status source"),
        ((B, N), "previous_controls"),
        ((B, F), "keys fine_range filtered"),
        ((B, C), "safe_range safe_direction"),
        ((B, config.anchor_count), "direction"),
        ((B, R), "anchor waypoint J_goal J_speed J_col S2 nearest"),
        ((B, R, 6), "coefficient"),
        ((B, R, N + 1), "guide states"),
        ((B, R, N), "controls"),
        ((B, M, N), "nominal"),
        ((B * M, K), "cost weight"),
        ((B * M, K, N), "noise sample_controls"),
        ((B * M, K, N + PROBES), "sample_positions sample_distance"),
        ((B * R, 1, N + PROBES + N), "positions distance"),
    ]
    arrays: Any = Arrays()
    shape_of = {name: shape for shape, names in shapes for name in names.split()}
    for name, shape in shape_of.items():
        setattr(arrays, name, wp.zeros(shape, dtype=Arrays.vars[name].type.dtype, device=planner.device))
    for name in ("fine_cells", "coarse_rows", "coarse_columns"):
        setattr(arrays, name, getattr(part, name))
    arrays.anchor_rows, arrays.anchor_columns = config.anchors.rows, config.anchors.columns
    for kind in ("previous", "brake"):
        setattr(arrays, f"{kind}_index", kinds.index(kind) if kind in kinds else -1)
    return arrays, tuple(shape_of)


def connect(arrays: Any, planner: Planner) -> None:
    """Let `arrays` refer to the planner's inputs, cloud and parameters, which it may have reallocated."""
    for field in fields(planner.inputs):
        setattr(arrays, field.name, getattr(planner.inputs, field.name))
    arrays.points, arrays.params = planner.points, planner.params
