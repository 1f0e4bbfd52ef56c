"""The choice of the best instance, and of a braking candidate if none is safe."""

# Postponed annotations are left out: functions made for a tuning refer to local types.

import functools

import warp as wp

from aero_planner.kernels.guides import BRAKING_CANDIDATES
from aero_planner.kernels.kernel_tuning import KernelTuning
from aero_planner.kernels.params import Params
from aero_planner.kernels.stops import STOPS, safe_clearances, widest_stop_limit
from aero_planner.kernels.warp_ops import read_lane, read_lane_integer
from aero_planner.plan import PlanStatus

wp.set_module_options({"enable_backward": False})

OK = wp.constant(int(PlanStatus.OK))
NO_SAFE_CANDIDATE = wp.constant(int(PlanStatus.NO_SAFE_CANDIDATE))
STALE_CLOUD = wp.constant(int(PlanStatus.STALE_CLOUD))

_PROVEN = wp.constant(int(BRAKING_CANDIDATES) - 1)
"""The stop that was proven last is the last braking candidate."""
_BrakingScores = wp.types.matrix(shape=(BRAKING_CANDIDATES, 3), dtype=wp.float32)


@functools.cache
def select_best(tuning: KernelTuning) -> wp.Function:
    """Return the function that selects the best instance, with `tuning.threads_per_instance` lanes per drone."""
    LANES = wp.constant(tuning.threads_per_instance)

    @wp.func
    def select_best(
        b: int,
        lane: int,
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

        An instance is safe if it stays `safe_clearance` away from every point, see `safe_clearances`. If the status is
        not OK, the braking candidate with the largest clearance is flown, among those that are clear of what stands if
        there are any: what seems to move may be an error. It replaces the "brake" instance, or the selected one if
        there is no such instance. If no braking candidate is clear of what stands, and a stop of an instance keeps a
        larger clearance than all of them and `widest_stop_limit`, that instance is flown, and that stop is kept.

        All lanes of a warp must call it; a CPU has one lane.

        Returns:
            Index of the selected instance, index of the row that is flown, index of the replaced instance or -1,
            status, index of the stop that is kept.
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
        for first in range(0, instances, LANES):
            # Every lane judges an instance of its own; then all of them compare the instances in order.
            m_lane = wp.min(first + lane, instances - 1)
            scores = instance_scores[b, m_lane]
            is_safe_lane = wp.where(scores[1] >= safe, 1, 0)
            clear_stop_lane = int(0)
            widest_lane = float(-wp.INF)
            widest_stop_lane = int(0)
            if c.prove_stop != 0:
                largest = float(-wp.INF)
                for j in range(STOPS):
                    d = stop_clearance[b, m_lane * STOPS + j]
                    # The first clear stop is kept: what is still unseen may be in the way of a later one.
                    if j == 0 or (d > largest and largest < stop_safe):
                        largest = d
                        clear_stop_lane = j
                    if d > widest_lane:
                        widest_lane = d
                        widest_stop_lane = j
                if c.prove_stop == 2:
                    is_safe_lane = 1
                if largest < stop_safe:
                    is_safe_lane = 0
            for j in range(wp.min(LANES, instances - first)):
                m = first + j
                cost = read_lane(scores[0], j)
                is_safe = read_lane_integer(is_safe_lane, j) != 0
                clear_stop = read_lane_integer(clear_stop_lane, j)
                d = read_lane(widest_lane, j)
                stop = read_lane_integer(widest_stop_lane, j)
                better = cost < lowest
                if c.prefer_safe != 0 and is_safe != best_safe:
                    better = is_safe
                if m == 0 or better:
                    best = m
                    best_stop = clear_stop
                    lowest = cost
                    best_safe = is_safe
                if d > widest:
                    widest = d
                    widest_stop = m * STOPS + stop
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

    return select_best
