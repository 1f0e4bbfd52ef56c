"""Device arrays of the core: dtype, shape, unit and meaning of each one. Stages declare theirs in the same way.

Shapes use these symbols:

    B   drones                              M   instances of a drone
    N   time steps of the horizon           R   rows: the M instances, then the candidates that stop
    K   samples of an instance              L   samples, rounded up to whole vectors
    A   anchors                             Q   Stage I positions of a sample: N states, then the probes
    F   fine cells, F0 rows x F1 columns    C   coarse cells
    G   cells of the clearance grid         V   packs of points in its list, of V0 points each
    W   workers: CPU threads, 1 on CUDA     T   noise sequences in the table
    S   sweeps of the cloud                 P   points of the cloud
    E   counters of a sweep
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import warp as wp

from aero_planner.array_memory import array, as_dict
from aero_planner.composition import Composition
from aero_planner.config import PlannerConfig
from aero_planner.config.planner_config import COARSE_COLUMNS, COARSE_ROWS
from aero_planner.device.kernel_tuning import KernelTuning
from aero_planner.device.records import CloudSweeps, bundle
from aero_planner.device.warp_ops import point_pack
from aero_planner.kernels.clearance import GRID
from aero_planner.kernels.guides import BRAKING_FAN
from aero_planner.kernels.mppi import NOISE_ROWS, PROBES
from aero_planner.kernels.sweep_change import SweepChange


@dataclass(eq=False)
class PlannerInputs:
    """Problem of each drone, world frame. The cloud is separate, see `Planner.points`."""

    time: wp.array = array(wp.float64, "B", "s", "Stamp of the state; NaN: 0.02 s after the previous one.")
    position: wp.array = array(wp.vec3, "B", "m", "p.")
    velocity: wp.array = array(wp.vec3, "B", "m/s", "v.")
    quaternion: wp.array = array(wp.vec4, "B", "", "q, w x y z, body to world; need not be normalised.")
    acceleration: wp.array = array(wp.vec3, "B", "m/s^2", "a; NaN: unknown.")
    disturbance: wp.array = array(wp.vec3, "B", "m/s^2", "a besides thrust and g; NaN: estimated from a.")
    goal_position: wp.array = array(wp.vec3, "B", "m", "p_goal.")
    goal_velocity: wp.array = array(wp.vec3, "B", "m/s", "v_goal; NaN: zero.")
    goal_quaternion: wp.array = array(wp.vec4, "B", "", "q_goal, w x y z; NaN: level, with the nose toward the goal.")
    cloud_age: wp.array = array(wp.float32, "B", "s", "Time since the cloud was measured.")
    is_blind: wp.array = array(wp.int32, "B", "", "1 where the newest sweep shows nothing, and should; else 0.")
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
    """The cloud, as sweeps in a ring; see `aero_planner.device.records.CloudSweeps`."""

    points: wp.array = array(wp.vec3, "B P", "m", "Points of the ring, world frame.")
    oldest: wp.array = array(wp.int32, "1", "", "Index of the first point of the oldest sweep.")
    start: wp.array = array(wp.int32, "S", "", "Index of the first point of each sweep.")
    count: wp.array = array(wp.int32, "B S", "", "Number of points of each sweep.")
    is_ordered: wp.array = array(wp.int32, "S", "", "1 for a sweep whose points are listed by shell, else 0.")
    origin: wp.array = array(wp.vec3, "B S", "m", "Position of the drone when each sweep arrived, world frame.")
    time: wp.array = array(wp.float64, "B S", "s", "Stamp of each sweep: when it arrived.")
    center: wp.array = array(wp.vec3, "B S", "m", "Centre of the shells of each sweep, world frame.")
    reach: wp.array = array(wp.float32, "B S", "m", "Radius of the first shell of each sweep.")
    shell_ends: wp.array = array(wp.int32, "B*S E", "", "End of each shell in the list, and the points not finite.")
    ordered_points: wp.array = array(wp.vec4, "B P", "m", "Points of each sweep by shell, and their indices.")

    def bundle(self) -> Any:
        """Return the arrays as the argument of a kernel."""
        return bundle(CloudSweeps, **as_dict(self))


@dataclass(eq=False)
class PlannerOutputs:
    """Everything that a `Plan` contains, under its names; rows of the candidates that stop follow the M instances."""

    fine_range: wp.array = array(wp.float32, "B F", "m", "r_ij; the maximum range where the cell is empty.")
    occupied: wp.array = array(wp.int32, "B F", "", "1 where the cell holds a point, 2 where a surface continues.")
    filtered_points: wp.array = array(wp.vec3, "B F", "m", "Nearest point of each occupied cell, world frame.")
    safe_range: wp.array = array(wp.float32, "B C", "m", "Largest fine range of each coarse cell.")
    safe_direction: wp.array = array(wp.vec3, "B C", "", "Direction of that fine cell, body frame.")
    initial_endpoints: wp.array = array(wp.vec3, "B R", "m", "Endpoints before refinement, world frame.")
    anchors: wp.array = array(wp.vec3, "B R", "m", "Refined endpoints, world frame.")
    guide_coefficients: wp.array = array(wp.vec3, "B R 6", "", "a_0 .. a_5 of the guides, SI units, world frame.")
    guides: wp.array = array(wp.vec3, "B R N+1", "m", "Guides at t = 0, dt, .., T, world frame.")
    controls: wp.array = array(wp.vec4, "B R N", "", "Optimised controls of the vehicle model.")
    positions: wp.array = array(wp.vec3, "B R N+1", "m", "Stage II rollouts, world frame.")
    velocities: wp.array = array(wp.vec3, "B R N+1", "m/s", "Stage II rollouts, world frame.")
    quaternions: wp.array = array(wp.vec4, "B R N+1", "", "Stage II rollouts, w x y z, body to world.")
    stage1_cost: wp.array = array(wp.float32, "B*M L", "", "S1 of every sample.")
    temperature: wp.array = array(wp.float32, "B M", "", "Temperature of the weights in Stage I.")
    stage2_cost: wp.array = array(wp.float32, "B R", "", "S2.")
    goal_cost: wp.array = array(wp.float32, "B R", "", "J_goal.")
    collision_cost: wp.array = array(wp.float32, "B R", "", "J_col.")
    clearance: wp.array = array(wp.float32, "B R N", "m", "Distance to the nearest filtered point, at most d_max.")
    best: wp.array = array(wp.int32, "B", "", "Index of the instance to fly.")
    status: wp.array = array(wp.int32, "B", "", "See `PlanStatus`.")
    braking_instance: wp.array = array(wp.int32, "B", "", "Instance that a candidate that stops has replaced, or -1.")
    flown: wp.array = array(wp.int32, "B", "", "Row that is flown: the best instance, or what has replaced it.")
    dropped_points: wp.array = array(wp.int32, "B", "", "Number of points that were not finite.")
    disturbance: wp.array = array(wp.vec3, "B", "m/s^2", "Acceleration besides control, g and drag, fed forward.")
    drag: wp.array = array(wp.float32, "B", "1/s", "Deceleration per velocity that is fed forward.")


@dataclass(eq=False)
class Workspace:
    """Intermediate results, tables and the state of the core that is carried from plan to plan."""

    active: wp.array = array(wp.int32, "B", "", "0 for drones for which nothing is planned.")
    position: wp.array = array(wp.vec3, "B", "m", "Position at which the plan takes effect, world frame.")
    velocity: wp.array = array(wp.vec3, "B", "m/s", "Velocity there, world frame.")
    quaternion: wp.array = array(wp.vec4, "B", "", "Attitude there, normalised, w x y z, body to world.")
    acceleration: wp.array = array(wp.vec3, "B", "m/s^2", "Acceleration there, world frame.")
    command: wp.array = array(wp.vec4, "B", "", "Control of the previous plan that is being flown.")
    control: wp.array = array(wp.vec4, "B", "", "Control in effect, which lags behind the commands.")
    period: wp.array = array(wp.float32, "B", "s", "Time since the previous plan, taken as that to the next one.")
    goal: wp.array = array(wp.vec3, "B", "m", "p_goal, at an allowed height, world frame.")
    goal_velocity: wp.array = array(wp.vec3, "B", "m/s", "v_goal, completed.")
    goal_quaternion: wp.array = array(wp.vec4, "B", "", "q_goal, completed, w x y z.")
    lookahead: wp.array = array(wp.float32, "B", "m", "l.")
    clip_guides: wp.array = array(wp.int32, "B", "", "1 where guides end before what their cells measured.")
    initial_directions: wp.array = array(wp.vec3, "B A", "", "Directions of the initial endpoints, body frame.")
    fine_directions: wp.array = array(wp.vec3, "F", "", "Table of the centre directions of the fine cells.")

    cell_keys: wp.array = array(wp.uint64, "W B F", "", "Range and place of the nearest point, inverted; 0: none.")
    worker_dropped: wp.array = array(wp.int32, "W B", "", "Points that were not finite, counted by each worker.")

    points_used: wp.array = array(wp.int32, "W B", "", "Points in each worker's part of the list.")
    cell_ends: wp.array = array(wp.int32, "B G", "", "Number of points, then begin, then end of each cell in the list.")
    pack_coordinates: wp.array = array(wp.float32, "B V 3 V0", "m", "Points of the list, world frame.")

    nominal_controls: wp.array = array(wp.vec4, "B R N", "", "Controls that follow the guides.")
    noise: wp.array = array(wp.float32, "N 4 T", "", "Table of white noise of unit variance.")
    sample_controls: wp.array = array(wp.float32, "B*M N 4 L", "", "Noisy, clamped controls.")
    sample_positions: wp.array = array(wp.float32, "B*M Q 3 L", "m", "Stage I rollouts and probes, world frame.")
    sample_clearance_cost: wp.array = array(wp.float32, "B*M Q K", "", "J_col of each state; 1 for a blocked probe.")
    sample_weights: wp.array = array(wp.float32, "B*M L", "", "Softmin weights, not normalised; 0 from K on.")

    state_costs: wp.array = array(wp.vec3, "B R N", "", "J_goal, J_col and the other terms of Stage II states.")
    state_clearance: wp.array = array(
        wp.float32, "B R Q+1", "m", "Clearance of Stage II states, probes and the start, less the speed margin."
    )
    static_clearance: wp.array = array(wp.float32, "B R Q+1", "m", "The same from static obstacles only.")
    least_clearance: wp.array = array(
        wp.vec2, "B R", "m", "Least of the states' clearances from all obstacles, and from static ones."
    )
    seed: wp.array = array(wp.int32, "B", "", "Seed of the noise.")
    tick: wp.array = array(wp.int32, "B", "", "Number of plans so far, which selects the noise.", kept="plans")
    previous_controls: wp.array = array(wp.vec4, "B N", "", "Controls to fly of the newest plan.", kept="plans")
    previous_start_control: wp.array = array(
        wp.vec4, "B", "", "Control in effect at the start of that plan.", kept="plans"
    )
    previous_end: wp.array = array(wp.vec3, "B", "m", "Final position of that plan, world frame.", kept="plans")
    previous_time: wp.array = array(
        wp.float64, "B", "s", "Stamp of that plan; NaN where there is none.", kept="plans", initial=math.nan
    )
    blind_time: wp.array = array(wp.float32, "B", "s", "For how long sweeps have shown nothing.", kept="plans")

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
    """Sizes of the arrays, by the symbols of the module's docstring, and of the stages' symbols."""

    B: int
    M: int
    R: int
    N: int
    K: int
    L: int
    A: int
    Q: int
    F: int
    F0: int
    F1: int
    C: int
    G: int
    V: int
    V0: int
    W: int
    T: int
    of_stages: Mapping[str, int] = field(default_factory=dict)

    def __getattr__(self, symbol: str) -> int:
        try:
            return self.__dict__["of_stages"][symbol]
        except KeyError:
            raise AttributeError(f"there is no size {symbol!r}") from None

    @classmethod
    def from_config(
        cls, config: PlannerConfig, composition: Composition, *, batch: int, workers: int, tuning: KernelTuning
    ) -> Sizes:
        """Return the sizes for a configuration, its composition, a batch and the kernels of a device."""
        sampling, M = config.sampling, len(config.kinds)
        rows, columns = config.fine_shape
        vector = max(tuning.samples_per_thread, tuning.samples_per_read)
        pack = tuning.points_per_pack
        # A point has copies in three layers, and with duplicates in three rows of each; a worker has every W-th layer.
        copies = (1 + 2 * tuning.for_batch(batch).duplicate_rows) * math.ceil(3 / workers)
        symbols = [stage.symbols(rows, columns) for stage in composition.stages if stage.symbols is not None]
        return cls(
            B=batch,
            M=M,
            R=M + int(BRAKING_FAN) + composition.stopping_rows,
            N=sampling.steps,
            K=sampling.samples,
            L=-(-sampling.samples // vector) * vector,
            A=config.anchor_count,
            Q=sampling.steps + int(PROBES),
            F=rows * columns,
            F0=rows,
            F1=columns,
            C=COARSE_ROWS * COARSE_COLUMNS,
            G=int(GRID) ** 3,
            V=workers * -(-rows * columns * copies // pack),
            V0=pack,
            W=workers,
            T=int(NOISE_ROWS),
            of_stages={symbol: size for sizes in symbols for symbol, size in sizes.items()},
        )

    @property
    def worker_capacity(self) -> int:
        """Number of points that fit into one worker's part of the list."""
        return self.V // self.W * self.V0
