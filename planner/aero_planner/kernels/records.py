"""Groups of arrays that kernels take as one argument. Shapes: B drones, R instances, N time steps."""

# Postponed annotations are left out: Warp structs need the types themselves.

from typing import Any

import warp as wp


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
    number: wp.array(dtype=int)  # [S], number of each sweep in the order of arrival
    center: wp.array2d(dtype=wp.vec3)  # [B, S], centre of the shells, world frame [m]
    reach: wp.array2d(dtype=float)  # [B, S], radius of the first shell [m]
    shell_ends: wp.array2d(dtype=int)  # [B S, COUNTERS], see `kernels.shells`
    # [B, P], points of each sweep by shell, from its start on: x, y, z [m] and the bits of their index in `points`
    ordered_points: wp.array2d(dtype=wp.vec4)
    # What moved when each sweep arrived, see `kernels.tracks`; X is `MOVERS`.
    tracked_from: wp.array(dtype=int)  # [S], number of the oldest sweep that was used; -1 if there were too few
    track_count: wp.array2d(dtype=int)  # [B, S]
    track_seen: wp.array2d(dtype=int)  # [B, S], number of those that this sweep shows; the others follow them
    track_position: wp.array3d(dtype=wp.vec2)  # [B, S, X], axis at that time, world frame [m]
    track_velocity: wp.array3d(dtype=wp.vec2)  # [B, S, X], world frame [m/s]
    track_radius: wp.array3d(dtype=float)  # [B, S, X], [m]
    # Places that moving obstacles have left since each sweep, see `kernels.wakes`; U is `WAKES`.
    wake_count: wp.array2d(dtype=int)  # [B, S]
    wake_position: wp.array3d(dtype=wp.vec2)  # [B, S, U], axis when the sweep arrived, world frame [m]
    wake_velocity: wp.array3d(dtype=wp.vec2)  # [B, S, U], world frame [m/s]
    wake_radius: wp.array3d(dtype=float)  # [B, S, U], [m]


@wp.struct
class DroneState:
    """State that plans start from, world frame, SI units."""

    position: wp.array(dtype=wp.vec3)  # [B]
    velocity: wp.array(dtype=wp.vec3)  # [B]
    quaternion: wp.array(dtype=wp.vec4)  # [B], unit, body to world
    acceleration: wp.array(dtype=wp.vec3)  # [B]
    disturbance: wp.array(dtype=wp.vec3)  # [B], acceleration besides thrust, gravity and drag that plans count on
    drag: wp.array(dtype=float)  # [B], deceleration per velocity that plans count on [1/s]
    control: wp.array(dtype=wp.vec4)  # [B], F_t and omega in effect
    command: wp.array(dtype=wp.vec4)  # [B], F_t and omega commanded


@wp.struct
class GoalState:
    """State at the goal, world frame, SI units."""

    position: wp.array(dtype=wp.vec3)  # [B]
    velocity: wp.array(dtype=wp.vec3)  # [B]
    quaternion: wp.array(dtype=wp.vec4)  # [B], unit, body to world


@wp.struct
class GuideSet:
    """Guides of all instances, world frame, SI units."""

    initial_endpoints: wp.array2d(dtype=wp.vec3)  # [B, R]
    anchors: wp.array2d(dtype=wp.vec3)  # [B, R]
    coefficients: wp.array3d(dtype=wp.vec3)  # [B, R, 6]
    positions: wp.array3d(dtype=wp.vec3)  # [B, R, N + 1]


@wp.struct
class Rollouts:
    """Stage II rollouts of all instances, world frame, SI units."""

    controls: wp.array3d(dtype=wp.vec4)  # [B, R, N], F_t and omega
    positions: wp.array3d(dtype=wp.vec3)  # [B, R, N + 1]
    velocities: wp.array3d(dtype=wp.vec3)  # [B, R, N + 1]
    quaternions: wp.array3d(dtype=wp.vec4)  # [B, R, N + 1], body to world


@wp.struct
class InstanceCosts:
    """Stage II costs of all instances."""

    goal_cost: wp.array2d(dtype=float)  # [B, R], J_goal
    collision_cost: wp.array2d(dtype=float)  # [B, R], J_col
    stage2_cost: wp.array2d(dtype=float)  # [B, R], S2


@wp.struct
class PreviousPlan:
    """Result of the previous plan, from which the next one continues."""

    controls: wp.array2d(dtype=wp.vec4)  # [B, N], F_t and omega
    start_control: wp.array(dtype=wp.vec4)  # [B], F_t and omega in effect at its start
    stop: wp.array2d(dtype=wp.vec4)  # [B, 2 N], controls of the stop that was proven last
    stop_age: wp.array(dtype=float)  # [B], time from that plan to the previous one [s]
    end: wp.array(dtype=wp.vec3)  # [B], final position of the rollout, world frame [m]
    waypoint: wp.array(dtype=wp.vec3)  # [B], waypoint beyond that, NaN where there was none, world frame [m]
    time: wp.array(dtype=wp.float64)  # [B], stamp [s], NaN where there is no previous plan


def bundle(struct: Any, **arrays: wp.array) -> Any:
    """Return an instance of a Warp struct with its arrays."""
    instance = struct()
    for name, array in arrays.items():
        setattr(instance, name, array)
    return instance
