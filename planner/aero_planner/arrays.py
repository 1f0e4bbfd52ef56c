"""Device arrays of the planner: dtype, shape, unit and meaning of each one.

Shapes use these symbols:

    B   drones                              M   instances of a drone
    N   time steps of the horizon           R   rows: the M instances, then the braking candidates
    K   samples of an instance              L   samples, rounded up to whole vectors
    A   anchors                             Q   Stage I positions of a sample: N states, then the probes
    F   fine cells, F0 rows x F1 columns    C   coarse cells
    G   cells of the clearance grid         V   packs of points in its list, of V0 points each
    J   stops of an instance                H   remembered places
    W   workers: CPU threads, 1 on CUDA     T   noise sequences in the table
    S   sweeps of the cloud                 P   points of the cloud
    Y   F, rounded up to whole multiples of the rows that the search for surfaces reads at once
    E   counters of a sweep                 X   moving obstacles
    U   wakes of a sweep
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import warp as wp

from aero_planner.array_memory import array, as_dict
from aero_planner.config import PlannerConfig
from aero_planner.kernels.clearance import GRID
from aero_planner.kernels.continuation import READ_ROWS
from aero_planner.kernels.escape import PLACES
from aero_planner.kernels.guides import BRAKING_CANDIDATES
from aero_planner.kernels.kernel_tuning import KernelTuning
from aero_planner.kernels.movers import MOVERS
from aero_planner.kernels.mppi import NOISE_ROWS, PROBES
from aero_planner.kernels.records import CloudSweeps, bundle
from aero_planner.kernels.stops import STOPS
from aero_planner.kernels.sweep_change import SweepChange
from aero_planner.kernels.warp_ops import point_pack


@dataclass(eq=False)
class PlannerInputs:
    """Problem of each drone, world frame. The cloud is separate, see `Planner.points`."""

    time: wp.array = array(wp.float64, "B", "s", "Stamp of the state; NaN: one replan_period after the previous one.")
    position: wp.array = array(wp.vec3, "B", "m", "p.")
    velocity: wp.array = array(wp.vec3, "B", "m/s", "v.")
    quaternion: wp.array = array(wp.vec4, "B", "", "q, w x y z, body to world; need not be normalised.")
    acceleration: wp.array = array(wp.vec3, "B", "m/s^2", "a; NaN: unknown.")
    disturbance: wp.array = array(wp.vec3, "B", "m/s^2", "a besides thrust and g; NaN: estimated from a.")
    goal_position: wp.array = array(wp.vec3, "B", "m", "p_goal.")
    goal_velocity: wp.array = array(wp.vec3, "B", "m/s", "v_goal; NaN: zero.")
    goal_quaternion: wp.array = array(wp.vec4, "B", "", "q_goal, w x y z; NaN: level, with the nose toward the goal.")
    cloud_age: wp.array = array(wp.float32, "B", "s", "Time since the cloud was measured.")
    ground_height: wp.array = array(wp.float32, "B", "m", "Height of flat ground; -inf where it is unknown.")
    point_count: wp.array = array(wp.int32, "B", "", "Number of points of the cloud.")


@dataclass(eq=False)
class SweepTable:
    """The places of the sweeps in the ring, as in `CloudArrays`, and the last change of them."""

    oldest: wp.array = array(wp.int32, "1", "", "Index of the first point of the oldest sweep.")
    start: wp.array = array(wp.int32, "S", "", "Index of the first point of each sweep.")
    count: wp.array = array(wp.int32, "B S", "", "Number of points of each sweep.")
    is_ordered: wp.array = array(wp.int32, "S", "", "1 for a sweep whose points are listed by shell, else 0.")
    change: wp.array = array(SweepChange, "1", "", "Sweeps that arrive or are thinned.")


@dataclass(eq=False)
class CloudArrays:
    """The cloud, as sweeps in a ring; see `aero_planner.kernels.records.CloudSweeps`."""

    points: wp.array = array(wp.vec3, "B P", "m", "Points of the ring, world frame.")
    oldest: wp.array = array(wp.int32, "1", "", "Index of the first point of the oldest sweep.")
    start: wp.array = array(wp.int32, "S", "", "Index of the first point of each sweep.")
    count: wp.array = array(wp.int32, "B S", "", "Number of points of each sweep.")
    is_ordered: wp.array = array(wp.int32, "S", "", "1 for a sweep whose points are listed by shell, else 0.")
    origin: wp.array = array(wp.vec3, "B S", "m", "Position of the drone when each sweep arrived, world frame.")
    time: wp.array = array(wp.float64, "B S", "s", "Stamp of each sweep: when it arrived.")
    number: wp.array = array(wp.int32, "S", "", "Number of each sweep in the order of arrival.")
    center: wp.array = array(wp.vec3, "B S", "m", "Centre of the shells of each sweep, world frame.")
    reach: wp.array = array(wp.float32, "B S", "m", "Radius of the first shell of each sweep.")
    shell_ends: wp.array = array(wp.int32, "B*S E", "", "End of each shell in the list, and the points not finite.")
    ordered_points: wp.array = array(wp.vec4, "B P", "m", "Points of each sweep by shell, and their indices.")
    tracked_from: wp.array = array(wp.int32, "S", "", "Number of the oldest sweep that the tracks of each one use.")
    track_count: wp.array = array(wp.int32, "B S", "", "Number of obstacles that moved when each sweep arrived.")
    track_seen: wp.array = array(wp.int32, "B S", "", "Number of those that the sweep shows; the others follow them.")
    track_position: wp.array = array(wp.vec2, "B S X", "m", "Their axes at that time, world frame.")
    track_velocity: wp.array = array(wp.vec2, "B S X", "m/s", "Their velocities, world frame.")
    track_radius: wp.array = array(wp.float32, "B S X", "m", "Their radii.")
    wake_count: wp.array = array(wp.int32, "B S", "", "Number of places that obstacles have left since each sweep.")
    wake_position: wp.array = array(wp.vec2, "B S U", "m", "Axes of these obstacles when the sweep arrived.")
    wake_velocity: wp.array = array(wp.vec2, "B S U", "m/s", "Their velocities, world frame.")
    wake_radius: wp.array = array(wp.float32, "B S U", "m", "Their radii.")

    def bundle(self) -> Any:
        """Return the arrays as the argument of a kernel."""
        return bundle(CloudSweeps, **as_dict(self))


@dataclass(eq=False)
class MotionArrays:
    """Moving obstacles of each drone; see `aero_planner.kernels.motion` and `.tracks`."""

    scan: wp.array = array(
        wp.int32, "B L A+K", "",
        "Nearest range of each bin of the recent sweeps, as an integer; then the number of circles of each block.",
    )  # fmt: skip
    circle_center: wp.array = array(
        wp.vec2, "B L A", "m", "Centre of the circle of the segment that begins at each bin, world frame."
    )
    circle_radius: wp.array = array(wp.float32, "B L A", "m", "Radius of this circle; 0 for none.")
    segment_count: wp.array = array(wp.int32, "B L", "", "Number of segments of each of these sweeps.")
    segment_center: wp.array = array(wp.vec2, "B L X", "m", "Centres of their circles, world frame.")
    segment_radius: wp.array = array(wp.float32, "B L X", "m", "Radii of their circles.")
    found_position: wp.array = array(wp.vec2, "B Y X", "m", "Axes of segments that move, by the sweep last seen in.")
    found_velocity: wp.array = array(wp.vec2, "B Y X", "m/s", "Their velocities, world frame.")
    found_radius: wp.array = array(wp.float32, "B Y X", "m", "Their radii; -1 for none.")
    newest: wp.array = array(wp.int32, "1", "", "Newest of these sweeps, whose tracks plans use; -1 for none.")


@dataclass(eq=False)
class PlannerOutputs:
    """Everything that a `Plan` contains, under its names; rows of the braking candidates follow the M instances."""

    fine_range: wp.array = array(wp.float32, "B F", "m", "r_ij; the maximum range where the cell is empty.")
    occupied: wp.array = array(wp.int32, "B F", "", "1 where the cell holds a point, 2 where a surface continues.")
    filtered_points: wp.array = array(wp.vec3, "B F", "m", "Nearest point of each occupied cell, world frame.")
    safe_range: wp.array = array(wp.float32, "B C", "m", "Largest fine range of each coarse cell.")
    safe_direction: wp.array = array(wp.vec3, "B C", "", "Direction of that fine cell, body frame.")
    initial_endpoints: wp.array = array(wp.vec3, "B R", "m", "Endpoints before refinement, world frame.")
    anchors: wp.array = array(wp.vec3, "B R", "m", "Refined endpoints, world frame.")
    guide_coefficients: wp.array = array(wp.vec3, "B R 6", "", "a_0 .. a_5 of the guides, SI units, world frame.")
    guides: wp.array = array(wp.vec3, "B R N+1", "m", "Guides at t = 0, dt, .., T, world frame.")
    controls: wp.array = array(wp.vec4, "B R N", "N, rad/s", "Optimised thrust F_t and body rates omega.")
    positions: wp.array = array(wp.vec3, "B R N+1", "m", "Stage II rollouts, world frame.")
    velocities: wp.array = array(wp.vec3, "B R N+1", "m/s", "Stage II rollouts, world frame.")
    quaternions: wp.array = array(wp.vec4, "B R N+1", "", "Stage II rollouts, w x y z, body to world.")
    stage1_cost: wp.array = array(wp.float32, "B*M L", "", "S1 of every sample.")
    stage2_cost: wp.array = array(wp.float32, "B R", "", "S2.")
    goal_cost: wp.array = array(wp.float32, "B R", "", "J_goal.")
    collision_cost: wp.array = array(wp.float32, "B R", "", "J_col.")
    clearance: wp.array = array(wp.float32, "B R N", "m", "Distance to the nearest filtered point, at most d_max.")
    best: wp.array = array(wp.int32, "B", "", "Index of the instance to fly.")
    status: wp.array = array(wp.int32, "B", "", "See `PlanStatus`.")
    braking_instance: wp.array = array(wp.int32, "B", "", "Instance that a braking candidate has replaced, or -1.")
    dropped_points: wp.array = array(wp.int32, "B", "", "Number of points that were not finite.")
    disturbance: wp.array = array(wp.vec3, "B", "m/s^2", "Acceleration besides thrust, g and drag, counted on.")
    drag: wp.array = array(wp.float32, "B", "1/s", "Deceleration per velocity, counted on.")
    mover_count: wp.array = array(wp.int32, "B", "", "Number of obstacles that were found to move.")
    mover_position: wp.array = array(wp.vec2, "B X", "m", "Their axes at the start of the plan, world frame.")
    mover_velocity: wp.array = array(wp.vec2, "B X", "m/s", "Their velocities, world frame.")
    mover_radius: wp.array = array(wp.float32, "B X", "m", "Their radii.")


@dataclass(eq=False)
class Workspace:
    """Intermediate results, tables and the state that the planner carries from plan to plan."""

    finished: wp.array = array(wp.int32, "B", "", "Other than 0 for drones for which nothing is planned.")
    position: wp.array = array(wp.vec3, "B", "m", "Position at which the plan takes effect, world frame.")
    velocity: wp.array = array(wp.vec3, "B", "m/s", "Velocity there, world frame.")
    quaternion: wp.array = array(wp.vec4, "B", "", "Attitude there, normalised, w x y z, body to world.")
    acceleration: wp.array = array(wp.vec3, "B", "m/s^2", "Acceleration there, world frame.")
    command: wp.array = array(wp.vec4, "B", "N, rad/s", "Control of the previous plan that is being flown.")
    control: wp.array = array(wp.vec4, "B", "N, rad/s", "Control in effect, which lags behind the commands.")
    goal_velocity: wp.array = array(wp.vec3, "B", "m/s", "v_goal, completed.")
    goal_quaternion: wp.array = array(wp.vec4, "B", "", "q_goal, completed, w x y z.")
    lookahead_length: wp.array = array(wp.float32, "B", "m", "l.")
    clip_guides: wp.array = array(wp.int32, "B", "", "1 where guides end before what their cells measured.")
    initial_directions: wp.array = array(wp.vec3, "B A", "", "Directions of the initial endpoints, body frame.")
    fine_directions: wp.array = array(wp.vec3, "F0 F1", "", "Table of the centre directions of the fine cells.")

    cell_keys: wp.array = array(wp.uint64, "W B F", "", "Range and place of the nearest point, inverted; 0: none.")
    worker_dropped: wp.array = array(wp.int32, "W B", "", "Points that were not finite, counted by each worker.")

    surfaces: wp.array = array(wp.vec2, "B 2 Y", "m", "Nearest surface to continue: distance, horizontal, and height.")

    points_used: wp.array = array(wp.int32, "W B", "", "Points in each worker's part of the list.")
    cell_ends: wp.array = array(wp.int32, "B G", "", "Number of points, then begin, then end of each cell in the list.")
    pack_coordinates: wp.array = array(wp.float32, "B V 3 V0", "m", "Points of the list, world frame.")

    waypoints: wp.array = array(wp.vec3, "B R", "m", "Waypoint of the cost-to-go; the goal where there is none.")
    nominal_controls: wp.array = array(wp.vec4, "B R N", "N, rad/s", "Controls that follow the guides.")
    noise: wp.array = array(wp.float32, "N 4 T", "", "Table of white noise of unit variance.")
    sample_controls: wp.array = array(wp.float32, "B*M N 4 L", "N, rad/s", "Noisy, clamped controls.")
    sample_positions: wp.array = array(wp.float32, "B*M Q 3 L", "m", "Stage I rollouts and probes, world frame.")
    sample_clearance_cost: wp.array = array(wp.float32, "B*M Q K", "", "J_col of each state; 1 for a blocked probe.")
    sample_weights: wp.array = array(wp.float32, "B*M L", "", "Softmin weights, not normalised; 0 from K on.")

    state_terms: wp.array = array(wp.vec4, "B R Q+N+1", "", "J_goal, J_col, speed cost, clearance of Stage II states.")
    standing_clearance: wp.array = array(wp.float32, "B R Q+N+1", "m", "The same clearance without what moves.")
    instance_scores: wp.array = array(wp.vec3, "B R", "", "S2, minimum clearance, and that without what moves [m].")

    plan_period: wp.array = array(wp.float32, "B", "s", "Time since the previous plan, taken as that to the next one.")
    stop_ready: wp.array = array(wp.int32, "B", "", "1 where a proven stop is left to fly.")
    stop_command: wp.array = array(wp.vec4, "B", "N, rad/s", "Mean control of the proven stop until the next plan.")
    stop_controls: wp.array = array(wp.vec4, "B M*J N", "N, rad/s", "Controls of the braking manoeuvre of each stop.")
    stop_positions: wp.array = array(wp.vec3, "B M*J N+1", "m", "Its rollout, world frame.")
    stop_clearance: wp.array = array(wp.float32, "B M*J", "m", "Least clearance of each stop, at most safe_clearance.")

    seed: wp.array = array(wp.int32, "B", "", "Seed of the noise.")
    tick: wp.array = array(wp.int32, "B", "", "Number of plans so far, which selects the noise.")
    previous_controls: wp.array = array(wp.vec4, "B N", "N, rad/s", "Controls to fly of the newest plan.")
    previous_start_control: wp.array = array(wp.vec4, "B", "N, rad/s", "Control in effect at the start of that plan.")
    mean_disturbance: wp.array = array(wp.vec3, "B", "m/s^2", "Mean acceleration that the model does not explain.")
    drag_means: wp.array = array(wp.vec2, "B", "m^2/s^3, m^2/s^2", "Means of -a v, a being unexplained, and of v^2.")
    view_quaternion: wp.array = array(wp.vec4, "B", "", "Attitude, body to world, that lags by `view_age` on average.")
    proven_stop: wp.array = array(wp.vec4, "B 2*N", "N, rad/s", "Controls of the stop that was proven last.")
    proven_stop_age: wp.array = array(wp.float32, "B", "s", "Time from that plan to the previous one.")
    places: wp.array = array(wp.vec3, "B H", "m", "Places without progress, world frame.")
    place_count: wp.array = array(wp.int32, "B", "", "Number of places remembered for the goal.")
    place_goal: wp.array = array(wp.vec3, "B", "m", "Goal for which they are remembered, world frame.")
    place_nearest: wp.array = array(wp.float32, "B", "m", "Distance to the goal when progress was last made.")
    place_idle: wp.array = array(wp.float32, "B", "s", "Time since then, or since a place was remembered.")
    previous_end: wp.array = array(wp.vec3, "B", "m", "Final position of that plan, world frame.")
    previous_waypoint: wp.array = array(wp.vec3, "B", "m", "Waypoint of that plan, world frame; NaN where none.")
    previous_time: wp.array = array(wp.float64, "B", "s", "Stamp of that plan; NaN where there is none.")

    @property
    def cell_counts(self) -> wp.array:
        """`cell_ends` in groups of four, shape [B, G / 4]; the same memory."""
        ends = self.cell_ends
        shape = (ends.shape[0], ends.shape[1] // 4)
        return wp.array(ptr=ends.ptr, dtype=wp.vec4i, shape=shape, device=ends.device)

    @property
    def point_packs(self) -> wp.array:
        """`pack_coordinates` as packs of points, shape [B, V]; the same memory."""
        points = self.pack_coordinates
        dtype = point_pack(points.shape[3])
        return wp.array(ptr=points.ptr, dtype=dtype, shape=points.shape[:2], device=points.device)


@dataclass(frozen=True)
class Sizes:
    """Sizes of the arrays, by the symbols of the module's docstring."""

    B: int
    M: int
    R: int
    J: int
    H: int
    N: int
    K: int
    L: int
    A: int
    Q: int
    F: int
    F0: int
    F1: int
    Y: int
    C: int
    G: int
    V: int
    V0: int
    W: int
    T: int
    X: int

    @classmethod
    def from_config(cls, config: PlannerConfig, *, batch: int, workers: int, tuning: KernelTuning) -> Sizes:
        """Return the sizes for a configuration, a batch and the kernels of a device."""
        part, sampling, M = config.partition, config.sampling, len(config.kinds)
        rows, columns = fine_shape(config)
        vector = max(tuning.samples_per_thread, tuning.samples_per_read)
        pack = tuning.points_per_pack
        # A point has copies in three layers, and with duplicates in three rows of each; a worker has every W-th layer.
        copies = (1 + 2 * tuning.for_batch(batch).duplicate_rows) * math.ceil(3 / workers)
        return cls(
            B=batch,
            M=M,
            R=M + int(BRAKING_CANDIDATES),
            J=int(STOPS),
            H=int(PLACES),
            N=sampling.steps,
            K=sampling.samples,
            L=-(-sampling.samples // vector) * vector,
            A=config.anchor_count,
            Q=sampling.steps + int(PROBES),
            F=rows * columns,
            F0=rows,
            F1=columns,
            Y=-(-rows // int(READ_ROWS)) * int(READ_ROWS) * columns,
            C=part.coarse_rows * part.coarse_columns,
            G=int(GRID) ** 3,
            V=workers * -(-rows * columns * copies // pack),
            V0=pack,
            W=workers,
            T=int(NOISE_ROWS),
            X=int(MOVERS),
        )

    @property
    def worker_capacity(self) -> int:
        """Number of points that fit into one worker's part of the list."""
        return self.V // self.W * self.V0


def fine_shape(config: PlannerConfig) -> tuple[int, int]:
    """Return the number of rows and columns of fine cells."""
    part = config.partition
    return part.coarse_rows * part.fine_cells, part.coarse_columns * part.fine_cells
