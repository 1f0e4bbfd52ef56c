"""The choice of the best instance, and of a braking candidate if none is safe."""

from __future__ import annotations

import warp as wp

from aero_planner.kernels.params import Params
from aero_planner.kernels.stops import STOPS, safe_clearances, widest_stop_limit
from aero_planner.plan import PlanStatus

wp.set_module_options({"enable_backward": False})

OK = wp.constant(int(PlanStatus.OK))
NO_SAFE_CANDIDATE = wp.constant(int(PlanStatus.NO_SAFE_CANDIDATE))
STALE_CLOUD = wp.constant(int(PlanStatus.STALE_CLOUD))


@wp.func
def select_best(
    b: int,
    instances: int,
    brake_index: int,
    start_clearance: float,
    cloud_age: float,
    c: Params,
    stop_ready: int,
    instance_scores: wp.array2d(dtype=wp.vec3),
    stop_clearance: wp.array2d(dtype=float),
):
    """Select the instance with the lowest S2; with `prefer_safe`, among the safe ones if there are any.

    An instance is safe if it stays `safe_clearance` away from every point, see `safe_clearances`. If the status is not
    OK, the braking candidate with the largest clearance is flown, among those that are clear of what stands if there
    are any: what seems to move may be an error. It replaces the "brake" instance, or the selected one if there is no
    such instance. If no braking candidate is clear of what stands, and a stop of an instance keeps a larger clearance
    than all of them and `widest_stop_limit`, that instance is flown, and that stop is kept.

    Returns:
        Index of the selected instance, index of the row that is flown, index of the replaced instance or -1, status,
        index of the stop that is kept.
    """
    safe, stop_safe = safe_clearances(start_clearance, c)
    best = int(0)
    best_stop = int(0)
    lowest = instance_scores[b, 0][0]
    best_safe = instance_scores[b, 0][1] >= safe
    widest = widest_stop_limit(stop_safe, c)
    widest_stop = int(-1)
    for m in range(instances):
        score = instance_scores[b, m]
        is_safe = score[1] >= safe
        clear_stop = int(0)
        if c.prove_stop != 0:
            largest = stop_clearance[b, m * STOPS]
            for j in range(1, STOPS):
                d = stop_clearance[b, m * STOPS + j]
                # The first clear stop is kept: what is still unseen may be in the way of a later one.
                if d > largest and largest < stop_safe:
                    largest = d
                    clear_stop = j
            for j in range(STOPS):
                if stop_clearance[b, m * STOPS + j] > widest:
                    widest = stop_clearance[b, m * STOPS + j]
                    widest_stop = m * STOPS + j
            has_stop = largest >= stop_safe
            is_safe = has_stop and (is_safe or c.prove_stop == 2)
        better = score[0] < lowest
        if c.prefer_safe != 0 and is_safe != best_safe:
            better = is_safe
        if better or m == 0:
            best = m
            best_stop = clear_stop
            lowest = score[0]
            best_safe = is_safe
    flown = best
    replaced = int(-1)
    status = wp.where(best_safe, OK, NO_SAFE_CANDIDATE)
    if cloud_age > c.cloud_age_max:
        status = STALE_CLOUD
    if status != OK:
        best = wp.where(brake_index >= 0, brake_index, best)
        replaced = best
        flown = instances
        largest_clearance = instance_scores[b, instances][1]
        is_clear = instance_scores[b, instances][2] >= stop_safe
        proven = instance_scores.shape[1] - 1
        may_fly_stop = c.prove_stop != 0 and stop_ready != 0 and status == NO_SAFE_CANDIDATE
        for candidate in range(instances + 1, wp.where(may_fly_stop, proven + 1, proven)):
            score = instance_scores[b, candidate]
            better = score[1] > largest_clearance
            if (score[2] >= stop_safe) != is_clear:
                better = not is_clear
            if better:
                flown = candidate
                largest_clearance = score[1]
                is_clear = score[2] >= stop_safe
        # The proven stop is flown on while it is clear of what stands, unless another one evades what moves.
        is_proof_valid = may_fly_stop and instance_scores[b, proven][2] >= stop_safe
        if is_proof_valid and (largest_clearance < stop_safe or instance_scores[b, proven][1] >= stop_safe):
            flown = proven
        elif status == NO_SAFE_CANDIDATE and not is_clear and widest_stop >= 0 and widest > largest_clearance:
            best = widest_stop // STOPS
            flown = best
            replaced = -1
            best_stop = widest_stop % STOPS
    return best, flown, replaced, status, best_stop
