"""The choice of the best instance, and of a braking candidate if none is safe."""

from __future__ import annotations

import warp as wp

from aero_planner.kernels.guides import BRAKING_CANDIDATES
from aero_planner.kernels.params import Params
from aero_planner.kernels.stops import STOPS, safe_clearances, widest_stop_limit
from aero_planner.plan import PlanStatus

wp.set_module_options({"enable_backward": False})

OK = wp.constant(int(PlanStatus.OK))
NO_SAFE_CANDIDATE = wp.constant(int(PlanStatus.NO_SAFE_CANDIDATE))
STALE_CLOUD = wp.constant(int(PlanStatus.STALE_CLOUD))

_PROVEN = wp.constant(int(BRAKING_CANDIDATES) - 1)
"""The stop that was proven last is the last braking candidate."""
_READ_WIDTH = wp.constant(4)
"""Instances whose scores are read together, so that a GPU waits for memory once for all of them."""
_Scores = wp.types.matrix(shape=(_READ_WIDTH, 3), dtype=wp.float32)
_Clearances = wp.types.matrix(shape=(_READ_WIDTH, STOPS), dtype=wp.float32)
_BrakingScores = wp.types.matrix(shape=(BRAKING_CANDIDATES, 3), dtype=wp.float32)


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
    lowest = float(wp.INF)
    best_safe = bool(False)
    widest = widest_stop_limit(stop_safe, c)
    widest_stop = int(-1)
    braking = _BrakingScores()
    for k in range(BRAKING_CANDIDATES):
        for j in range(3):
            braking[k, j] = instance_scores[b, instances + k][j]
    scores = _Scores()
    clearances = _Clearances()
    for first in range(0, instances, _READ_WIDTH):
        for k in range(_READ_WIDTH):
            m = wp.min(first + k, instances - 1)
            for j in range(3):
                scores[k, j] = instance_scores[b, m][j]
            for j in range(STOPS):
                clearances[k, j] = stop_clearance[b, m * STOPS + j]
        for k in range(_READ_WIDTH):
            m = first + k
            is_safe = scores[k, 1] >= safe
            clear_stop = int(0)
            if c.prove_stop != 0:
                largest = clearances[k, 0]
                for j in range(1, STOPS):
                    d = clearances[k, j]
                    # The first clear stop is kept: what is still unseen may be in the way of a later one.
                    if d > largest and largest < stop_safe:
                        largest = d
                        clear_stop = j
                for j in range(STOPS):
                    if m < instances and clearances[k, j] > widest:
                        widest = clearances[k, j]
                        widest_stop = m * STOPS + j
                has_stop = largest >= stop_safe
                is_safe = has_stop and (is_safe or c.prove_stop == 2)
            better = scores[k, 0] < lowest
            if c.prefer_safe != 0 and is_safe != best_safe:
                better = is_safe
            if m == 0 or (better and m < instances):
                best = m
                best_stop = clear_stop
                lowest = scores[k, 0]
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
        largest_clearance = braking[0, 1]
        is_clear = braking[0, 2] >= stop_safe
        may_fly_stop = c.prove_stop != 0 and stop_ready != 0 and status == NO_SAFE_CANDIDATE
        for k in range(1, BRAKING_CANDIDATES):
            better = braking[k, 1] > largest_clearance
            if (braking[k, 2] >= stop_safe) != is_clear:
                better = not is_clear
            if better and (k < _PROVEN or may_fly_stop):
                flown = instances + k
                largest_clearance = braking[k, 1]
                is_clear = braking[k, 2] >= stop_safe
        # The proven stop is flown on while it is clear of what stands, unless another one evades what moves.
        is_proof_valid = may_fly_stop and braking[_PROVEN, 2] >= stop_safe
        if is_proof_valid and (largest_clearance < stop_safe or braking[_PROVEN, 1] >= stop_safe):
            flown = instances + _PROVEN
        elif status == NO_SAFE_CANDIDATE and not is_clear and widest_stop >= 0 and widest > largest_clearance:
            best = widest_stop // STOPS
            flown = best
            replaced = -1
            best_stop = widest_stop % STOPS
    return best, flown, replaced, status, best_stop
