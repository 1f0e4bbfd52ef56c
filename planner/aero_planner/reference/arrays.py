"""Device arrays of the reference: dtype, shape, unit and meaning of each one.

M instances, K samples, N time steps, P points, F0 x F1 fine cells, C0 x C1 coarse cells. All that is not in the body
frame is in the world frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from aero_planner.array_memory import array
from aero_planner.reference.dynamics import State


@dataclass(eq=False)
class ReferenceArrays:
    """Inputs and results of the stages, in their order."""

    points: wp.array = array(wp.vec3, "P", "m", "The last sweeps.")
    noise: wp.array = array(wp.vec4, "M K N", "", "White noise e of unit variance.")
    directions: wp.array = array(wp.vec3, "M", "", "Directions of the initial endpoints, body frame.")
    initial_endpoints: wp.array = array(wp.vec3, "M", "m", "Endpoints before the refinement.")
    keys: wp.array = array(wp.uint64, "F0 F1", "", "Range and index of the nearest point of each cell.")
    dropped_points: wp.array = array(wp.int32, "1", "", "Number of points that are not finite.")
    fine_range: wp.array = array(wp.float32, "F0 F1", "m", "r_ij; r_max where the cell is empty.")
    filtered_points: wp.array = array(wp.vec3, "F0 F1", "m", "Nearest point of each cell, infinite where it is empty.")
    safe_range: wp.array = array(wp.float32, "C0 C1", "m", "Largest r_ij of each coarse cell.")
    safe_direction: wp.array = array(wp.vec3, "C0 C1", "", "Direction of that fine cell, body frame.")
    anchors: wp.array = array(wp.vec3, "M", "m", "Refined endpoints.")
    guide_coefficients: wp.array = array(wp.vec3, "M 6", "", "a_0 .. a_5 of the guides, SI units.")
    guides: wp.array = array(wp.vec3, "M N+1", "m", "Guides at t = 0, dt, .. T.")
    nominal_controls: wp.array = array(wp.vec4, "M N", "N, rad/s", "Controls that follow the guides.")
    sample_controls: wp.array = array(wp.vec4, "M K N", "N, rad/s", "Noisy, clamped controls.")
    sample_states: wp.array = array(State, "M K N+1", "", "Their rollouts.")
    sample_clearance: wp.array = array(wp.float32, "M K N", "m", "Distance of each state to the filtered cloud.")
    stage1_cost: wp.array = array(wp.float32, "M K", "", "S1.")
    sample_weights: wp.array = array(wp.float32, "M K", "", "w_k.")
    controls: wp.array = array(wp.vec4, "M 1 N", "N, rad/s", "Optimised controls.")
    states: wp.array = array(State, "M 1 N+1", "", "Their rollouts.")
    clearance: wp.array = array(wp.float32, "M 1 N", "m", "Distance of each state to the filtered cloud.")
    goal_cost: wp.array = array(wp.float32, "M", "", "J_goal.")
    collision_cost: wp.array = array(wp.float32, "M", "", "J_col.")
    stage2_cost: wp.array = array(wp.float32, "M", "", "S2.")
    best: wp.array = array(wp.int32, "1", "", "Instance with the lowest S2.")
