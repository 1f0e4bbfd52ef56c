"""State and goal that the planner takes, and the plan that it returns, as NumPy arrays."""

from __future__ import annotations

import enum
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from typing_extensions import Self

Array = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class VehicleState:
    """State of the quadrotor, world frame. With a batch of B drones every array has a leading axis B.

    Args:
        position: p [m], shape [3].
        velocity: v [m/s], shape [3].
        quaternion: q, body to world, order w, x, y, z, shape [4]; need not be normalised.
        acceleration: a [m/s^2], shape [3], measured; None means unknown: guides begin without any.
        time: stamp of the state [s], from which follows how far the previous plan has been flown. None means one
            0.02 s after the previous state.
        disturbance: acceleration that neither thrust nor gravity explains [m/s^2], shape [3]; None means that the
            planner estimates it from the acceleration. Drag is a part of it, see `disturbance.drag_time`.
    """

    position: ArrayLike
    velocity: ArrayLike
    quaternion: ArrayLike
    acceleration: ArrayLike | None = None
    time: ArrayLike | None = None
    disturbance: ArrayLike | None = None


@dataclass(frozen=True, eq=False)
class Goal:
    """State at the goal, world frame. With a batch of B drones every array has a leading axis B.

    Args:
        position: p_goal [m], shape [3].
        velocity: v_goal [m/s], shape [3]; None means zero: arrive and stop.
        quaternion: q_goal, body to world, order w, x, y, z, shape [4]; None means level, with the nose toward the goal,
            or with the current heading when the goal is less than 0.5 m away horizontally.
    """

    position: ArrayLike
    velocity: ArrayLike | None = None
    quaternion: ArrayLike | None = None


class PlanStatus(enum.IntEnum):
    """Safety of a plan; `controls[best]` may be flown in any case."""

    OK = 0
    """The best candidate is admissible: it keeps its clearance over the whole horizon or, with a stop proof, as far as
    the first of its stops that is clear."""
    NO_SAFE_CANDIDATE = 1
    """No candidate is admissible. `controls[best]` is a braking sequence or the stop that was proven last, and its kind
    is "brake"; where neither is clear, it may be the instance whose stop keeps the largest clearance."""
    STALE_CLOUD = 2
    """The cloud is older than partition.cloud_age_max, or has shown nothing for as long; `controls[best]` is a braking
    sequence."""


@dataclass(frozen=True, eq=False)
class BrakingCandidates:
    """The rollouts that stop the drone: straight ahead, then alternately to the left and to the right."""

    positions: Array
    """[m], shape [5, N+1, 3], world frame."""
    velocities: Array
    """[m/s], shape [5, N+1, 3], world frame."""
    clearance: Array
    """Smallest distance to the filtered points, at most d_max [m], shape [5]."""


@dataclass(frozen=True, eq=False)
class MovingObstacles:
    """Vertical cylinders that the planner expects to move on at a constant velocity; their radii grow meanwhile."""

    positions: Array
    """Axes when the plan takes effect [m], shape [n, 2], world frame."""
    velocities: Array
    """[m/s], shape [n, 2], world frame."""
    radii: Array
    """When the plan takes effect [m], shape [n]. They grow by 0.1 m/s."""


def _none() -> None:
    """Return the default of a field that `Plan.with_lazy_arrays` may make: a plain default would hide that one."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PlanArrays:
    """What the plans of one drone and of a batch have in common. The arrays are copies that no later call changes.

    There are M instances (anchors first) with K samples each, and N time steps of dt. With a batch of B drones, every
    array has a leading axis B.
    """

    extensions: ClassVar[tuple[str, ...]] = ("cells", "anchors", "guides", "samples", "tracks")
    """What it has besides candidate paths, their costs and the choice."""

    fine_range: Array
    """r_ij: nearest range of each fine cell, `PlannerConfig.farthest_range` where it is empty [m], shape [80, 160] by
    default, body frame. Rows are elevations from -90 deg, columns azimuths from -180 deg."""
    continued_cells: NDArray[np.bool_] | None
    """True for each fine cell whose range is that of a continued surface, which was not measured, shape [80, 160], body
    frame; None if no stage continues surfaces, and in plans of a drone with an older version."""
    safe_range: Array
    """Largest fine range of each coarse cell [m], shape [10, 20]."""
    safe_direction: Array
    """Direction of that fine cell, shape [10, 20, 3], body frame."""
    initial_endpoints: Array
    """Endpoints before the refinement [m], shape [M, 3], world frame."""
    anchors: Array
    """Refined endpoints [m], shape [M, 3], world frame."""
    guide_coefficients: Array
    """a_0 .. a_5 of the quintic guides per axis, shape [M, 3, 6], world frame."""
    guides: Array
    """Guides at t = 0, dt, .., T [m], shape [M, N+1, 3], world frame."""
    kinds: tuple[str, ...]
    """"anchor" for the first M_h M_v instances, then "previous" where configured, length M; "brake" for the best one if
    a candidate that stops has replaced it."""
    controls: Array
    """Optimised controls of the vehicle model, by default thrust F_t [N] and body rates omega [rad/s], shape [M, N, 4].
    While a proven stop is flown, its first control is the mean until the next plan, and its rollout has that over the
    time step."""
    positions: Array
    """Positions of the Stage II rollouts [m], shape [M, N+1, 3], world frame."""
    velocities: Array
    """Velocities of the Stage II rollouts [m/s], shape [M, N+1, 3], world frame."""
    quaternions: Array
    """Attitudes of the Stage II rollouts, body to world, w x y z, shape [M, N+1, 4]."""
    stage1_cost: Array
    """S1 of every sample, shape [M, K]."""
    temperature: Array | None = field(default_factory=_none, kw_only=True)
    """Temperature of the weights of every instance in Stage I, shape [M]; None in plans of a drone with an older
    version."""
    stage2_cost: Array
    """S2 of every instance, shape [M]: J_goal + J_col, and the terms of the options that are on."""
    goal_cost: Array
    """J_goal of every instance, shape [M]."""
    collision_cost: Array
    """J_col of every instance, shape [M]."""
    clearance: Array
    """Distance to the nearest filtered point or dynamic obstacle after each control, at most d_max [m], [M, N]."""
    disturbance: Array | None = None
    """Acceleration besides thrust, gravity and drag that the plan counts on [m/s^2], shape [3], world frame; see
    disturbance.disturbance_time. None in plans of a drone with an older version."""
    stage_ms: dict[str, float] = field(default_factory=dict)
    """Time of each stage [ms]."""
    samples: Array | None = None
    """Positions of the Stage I rollouts [m], shape [M, K, N+1, 3], world frame; None unless requested."""
    braking: BrakingCandidates | None = field(default_factory=_none)
    """None in plans that a drone has sent."""
    moving: MovingObstacles | None = field(default_factory=_none)
    """Obstacles that were found to move; None if no stage looks for them, with a batch, and in plans that a drone has
    sent."""
    model: str = "ctbr"
    """Vehicle model, which says what the controls are; see vehicle.model."""

    @classmethod
    def with_lazy_arrays(cls, make: Callable[[str], Any], **known: Any) -> Self:
        """Return a plan whose fields are `known`, or the results of `make` for their names when they are first read."""
        plan = object.__new__(cls)
        plan.__dict__.update(known, _make=make)
        return plan

    if not TYPE_CHECKING:  # a type checker would accept every name

        def __getattr__(self, name: str) -> Any:
            make = None if name.startswith("_") else self.__dict__.get("_make")
            if make is None:
                raise AttributeError(f"a plan has no attribute {name!r}")
            return self.__dict__.setdefault(name, make(name))


@dataclass(frozen=True, eq=False, kw_only=True)
class Plan(PlanArrays):
    """Result of one `Planner.plan` call for one drone."""

    filtered_points: Array
    """Nearest point of each occupied fine cell [m], shape [F, 3], world frame, including those of `continued_cells`."""
    best: int
    """Index of the instance to fly: `controls[best]`."""
    status: PlanStatus
    dropped_points: int
    """Number of points that were not finite."""
    drag: float | None = None
    """Deceleration per velocity that the plan counts on [1/s], see disturbance.drag_time. None as for `disturbance`."""

    @property
    def cost(self) -> Array:
        """S2 of every instance, shape [M]."""
        return self.stage2_cost

    @property
    def costs(self) -> dict[str, Array]:
        """J_goal and J_col of every instance, by label, each of shape [M]."""
        return {"goal": self.goal_cost, "collision": self.collision_cost}

    @property
    def command(self) -> Array:
        """Controls to fly, `controls[best]`, shape [N, 4]."""
        return self.controls[self.best]


@dataclass(frozen=True, eq=False, kw_only=True)
class BatchPlan(PlanArrays):
    """Result of one `Planner.plan` call for a batch of B drones."""

    filtered_points: list[Array]
    """As in `Plan`, for each drone."""
    best: NDArray[np.int32]
    """Index of the instance to fly of each drone, shape [B]."""
    status: NDArray[np.int32]
    """`PlanStatus` of each drone, shape [B]."""
    dropped_points: NDArray[np.int32]
    """Number of points of each drone that were not finite, shape [B]."""
    drag: Array
    """As in `Plan`, shape [B]."""

    @property
    def command(self) -> Array:
        """Controls to fly, shape [B, N, 4]."""
        return self.controls[np.arange(len(self.best)), self.best]
