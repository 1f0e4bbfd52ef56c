"""The stage that proves backup stops."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import warp as wp

from aero_planner.array_memory import array
from aero_planner.recorder import Recorder
from aero_planner.stage import Hooks, Launches, Stage
from aero_planner.stages.stop_proof import proven_stop, stops
from aero_planner.stages.stop_proof.stops import STOPS

_NAME = "stop_proof"
_STOPS = int(STOPS)


@dataclass(eq=False)
class Arrays:
    """Backup stops, and the one that was proven last."""

    stop_controls: wp.array = array(wp.vec4, f"B M*{_STOPS} N", "", "Controls of the braking manoeuvre of each stop.")
    stop_positions: wp.array = array(wp.vec3, f"B M*{_STOPS} N+1", "m", "Its rollout, world frame.")
    stop_clearance: wp.array = array(
        wp.float32, f"B M*{_STOPS}", "m", "Least clearance of each stop, at most safe_clearance."
    )
    proven_stop: wp.array = array(wp.vec4, "B 2*N", "", "Controls of the stop that was proven last.", kept="plans")
    proven_stop_age: wp.array = array(
        wp.float32, "B", "s", "Time from that plan to the previous one.", kept="plans", initial=math.inf
    )
    stop_ready: wp.array = array(wp.int32, "B", "", "1 where a proven stop is left to fly.")
    stop_command: wp.array = array(wp.vec4, "B", "", "Mean control of the proven stop until the next plan.")


def _continue(r: Recorder) -> list[list[Launches]]:
    launch = r.record(
        proven_stop.continue_stop(r.tuning, r.composition),
        (r.sizes.B, r.tuning.threads_per_instance),
        inputs=[r.problem, r.start, r.params, r.previous],
        outputs=[_proven(r), r.guides, r.work.nominal_controls],
        block_dim=32,
    )
    return [[[launch]]]


def _shared(r: Recorder, kernel: Any, more: tuple[int, ...], inputs: list[Any]) -> list[list[Launches]]:
    """Record a launch over all stops, in as many shares as there are workers."""
    count, shares = r.sizes.M * _STOPS, r.sizes.W if r.sizes.W == 1 else 4 * r.sizes.W
    bounds = sorted({count * share // shares for share in range(shares + 1)})  # few instances give fewer shares
    return [[
        [r.record(
            kernel, (r.sizes.B, end - first, *more), inputs=[first, r.problem, r.start, r.params, *inputs],
            outputs=[r.bind(stops.Stops, _NAME)], block_dim=32,
        )]
        for first, end in itertools.pairwise(bounds)
    ]]  # fmt: skip


def _roll_out(r: Recorder) -> list[list[Launches]]:
    return _shared(r, stops.roll_out_stops(r.tuning, r.composition), (), [r.rollouts])


def _evaluate(r: Recorder) -> list[list[Launches]]:
    groups = -(-2 * r.sizes.N // r.batch_tuning.rows_per_stop_query)
    kernel = stops.evaluate_stops(r.batch_tuning, r.composition)
    inputs = [r.cells, r.grid, r.views, r.rollouts.positions, r.scores]
    return _shared(r, kernel, (groups, r.batch_tuning.threads_per_stop_query), inputs)


def _keep(r: Recorder) -> list[list[Launches]]:
    launch = r.record(
        proven_stop.keep_stop(r.tuning, r.composition),
        (r.sizes.B, r.tuning.threads_per_instance),
        inputs=[r.start, r.params, r.choice, r.scores, r.bind(stops.Stops, _NAME)],
        outputs=[r.rollouts, r.previous, _proven(r)],
        block_dim=32,
    )
    return [[[launch]]]


def _proven(r: Recorder) -> Any:
    return r.bind(proven_stop.ProvenStop, _NAME)


STAGE = Stage(
    name=_NAME,
    label="Stop proof",
    arrays=Arrays,
    view=stops.StopProof,
    hooks=Hooks(admissible=stops.has_clear_stop, fallback=stops.fly_proven_stop),
    stopping_rows=1,
    launches={"guides": _continue, "rollouts": _roll_out, "proof": _evaluate, "end": _keep},
)
