"""The planner's arrays: those of a plan, and the groups of them that kernels take as one argument."""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from aero_planner.arrays import CloudArrays, PlannerInputs, PlannerOutputs, Workspace
from aero_planner.kernels.escape import Escape
from aero_planner.kernels.movers import Movers
from aero_planner.kernels.records import DroneState, GoalState, GuideSet, InstanceCosts, PreviousPlan, Rollouts, bundle
from aero_planner.motion import Motion


@dataclass(frozen=True, eq=False)
class PipelineArrays:
    """Arrays that the launches of a plan read and write, all on one device."""

    inputs: PlannerInputs
    outputs: PlannerOutputs
    work: Workspace
    cloud: CloudArrays
    """The sweeps to plan from."""
    change: wp.array | None
    """How these sweeps change; None for a cloud that the caller has joined."""
    motion: Motion
    """What moves among their obstacles."""
    params: wp.array
    """Live parameters, shape [B]."""


class PipelineRecords:
    """Groups of the arrays; see `aero_planner.kernels.records` for their fields.

    Args:
        i, o, w: inputs, outputs and workspace of the planner.

    Attributes:
        given_drone, given_goal: state and goal as the caller gives them.
        drone, goal: those that plans start from and lead to: the predicted state, and the goal without NaN.
        guides, rollouts, costs: arrays of the instances and the braking candidates.
        previous: what the previous plan leaves to the next one.
        escape: places without progress.
        movers: moving obstacles at the start of the plan.
    """

    def __init__(self, i: PlannerInputs, o: PlannerOutputs, w: Workspace) -> None:
        self.given_drone, self.drone = (
            bundle(
                DroneState,
                position=arrays.position,
                velocity=arrays.velocity,
                quaternion=arrays.quaternion,
                acceleration=arrays.acceleration,
                disturbance=disturbance,
                drag=o.drag,
                command=w.command,
                control=w.control,
            )
            for arrays, disturbance in ((i, i.disturbance), (w, o.disturbance))
        )
        self.given_goal, self.goal = (
            bundle(
                GoalState, position=i.goal_position, velocity=arrays.goal_velocity, quaternion=arrays.goal_quaternion
            )
            for arrays in (i, w)
        )
        self.guides = bundle(
            GuideSet,
            initial_endpoints=o.initial_endpoints,
            anchors=o.anchors,
            coefficients=o.guide_coefficients,
            positions=o.guides,
        )
        self.rollouts = bundle(
            Rollouts, controls=o.controls, positions=o.positions, velocities=o.velocities, quaternions=o.quaternions
        )
        self.costs = bundle(
            InstanceCosts, goal_cost=o.goal_cost, collision_cost=o.collision_cost, stage2_cost=o.stage2_cost
        )
        self.previous = bundle(
            PreviousPlan,
            controls=w.previous_controls,
            start_control=w.previous_start_control,
            stop=w.proven_stop,
            stop_age=w.proven_stop_age,
            end=w.previous_end,
            waypoint=w.previous_waypoint,
            time=w.previous_time,
        )
        self.movers = bundle(
            Movers,
            count=o.mover_count,
            position=o.mover_position,
            velocity=o.mover_velocity,
            radius=o.mover_radius,
        )
        self.escape = bundle(
            Escape, places=w.places, count=w.place_count, goal=w.place_goal, nearest=w.place_nearest, idle=w.place_idle
        )
