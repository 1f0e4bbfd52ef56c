"""Speed guard: compare the planner with the reference of the paper in one run, by ratios that hold on any machine."""

from __future__ import annotations

import functools
import json
import sys
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import warp as wp

from aero_planner import Plan, Planner, PlannerConfig
from aero_planner.benchmark import elapsed_ms
from aero_planner.cli_util import run_command
from aero_planner.forest_cloud import forest_flight
from aero_planner.reference import ReferencePlanner
from aero_planner.reference.planner import STAGES
from aero_planner.sampled_noise import noise_of_next_plan
from benchmarks.common import config_of, machine, make_parser, positive

BOUNDS = {
    "cpu": {"plan": 75.0, "partition": 1.6, "rollouts": 2.3, "default": 50.0},
    "cuda": {"plan": 1.2, "default": 1.0},
}
"""Minimum ratios of the whole plan, of stages, and of a plan with the preset "default", by kind of device: about half
of the measured values. The reference finds the clearance by brute force, which dominates its plan, hence the bounds on
other stages."""

_WARM_UP = 2
_IN_A_ROW = 3
"""Plans after each plan of the reference. The first of them finds cold caches, which cost it several times the rest
where processors are shared."""


class PlansDifferError(RuntimeError):
    """The planner and the reference plan differently."""


def compare_with_reference(
    config: PlannerConfig,
    default: PlannerConfig,
    *,
    device: str = "cpu",
    points: int = 200_000,
    threads: int | None = 1,
    repeat: int = 10,
) -> dict[str, Any]:
    """Time the reference and the planner alternately, on the same plan, and the planner with the default preset.

    By default the planner has one thread, like the reference, so the ratio does not depend on the number of cores.

    Args:
        config: the preset "paper" with other values of its parameters.
        default: the preset "default" with other values, for which the reference has no counterpart: its time is
            compared with that of the reference for `config`.

    Returns:
        "stages": {name: {"reference_ms", "planner_ms", "ratio"}}, on the CPU only. "plan": the same for the whole plan,
        from the device inputs to the device outputs. "default": the same for `default`. Every time is the minimum of
        `repeat` times, since other processes can only add to it. And the arguments.

    Raises:
        ValueError: the device does not exist, or the configuration has options that the paper lacks.
        PlansDifferError: planner and reference plan differently, so that their times say nothing.
    """
    planner, full = (Planner(options, device=device, threads=threads) for options in (config, default))
    reference = ReferencePlanner(config, device=device)
    state, goal, cloud = forest_flight(points)
    expected = reference.plan(state, goal, cloud, noise_of_next_plan(planner)[0])
    _check_agreement(planner.plan(state, goal, cloud), expected)
    stages: dict[str, tuple[list[float], list[float]]] = {name: ([], []) for name in STAGES}
    plans: tuple[list[float], list[float]] = ([], [])
    default_times: list[float] = []
    is_cpu = device == "cpu"
    launches = _launches(reference, device)
    for i in range(_WARM_UP + repeat):
        reference_times = {name: elapsed_ms(launch, device) for name, launch in launches.items()}
        full.plan(state, goal, cloud)
        several = [planner.plan(state, goal, cloud).stage_ms for _ in range(_IN_A_ROW)]
        if i < _WARM_UP:
            continue
        plans[0].append(sum(reference_times.values()))
        plans[1].extend(elapsed_ms(planner.launch, device) for _ in range(_IN_A_ROW))
        default_times.extend(elapsed_ms(full.launch, device) for _ in range(_IN_A_ROW))
        for name in STAGES if is_cpu else ():
            stages[name][0].append(reference_times[name])
            stages[name][1].extend(times[name] for times in several)
    planner.close()
    full.close()
    return {
        "device": device,
        "machine": machine(device),
        "points": points,
        "samples": config.sampling.samples,
        "steps": config.sampling.steps,
        "instances": len(config.kinds),
        "threads": threads,
        "repeat": repeat,
        "stages": {name: _row(*times) for name, times in stages.items() if is_cpu},
        "plan": _row(*plans),
        "default": _row(plans[0], default_times),
    }


def _launches(reference: ReferencePlanner, device: str) -> dict[str, Callable[[], None]]:
    """Return functions that launch the reference's stages by name; on CUDA one for all of them, as a graph."""
    if device == "cpu":
        return {name: functools.partial(reference.launch, name) for name in STAGES}
    with wp.ScopedDevice(device), wp.ScopedCapture() as capture:
        for name in STAGES:
            reference.launch(name)
    graph: Any = capture.graph
    return {"graph": functools.partial(wp.capture_launch, graph)}


def _check_agreement(plan: Plan, expected: Plan) -> None:
    if not np.array_equal(plan.fine_range, expected.fine_range) or plan.best != expected.best:
        raise PlansDifferError(
            "the planner and the reference plan differently, so their times can't be compared; "
            "run tests/planner/test_reference.py to see where they differ."
        )


def _row(reference: Sequence[float], planner: Sequence[float]) -> dict[str, float]:
    return {"reference_ms": min(reference), "planner_ms": min(planner), "ratio": min(reference) / min(planner)}


def _rows(result: dict[str, Any]) -> dict[str, dict[str, float]]:
    """Return the rows of the report by name."""
    return {**result["stages"], "plan": result["plan"], "default": result["default"]}


def _format_report(result: dict[str, Any]) -> str:
    rows = _rows(result)
    return "\n".join([
        f"{result['device']} ({result['machine']}), {result['points']} points, {result['instances']} instances x "
        f"{result['samples']} samples x {result['steps']} steps, threads {result['threads']}, {result['repeat']} plans",
        f"{'':12}{'reference ms':>14}{'planner ms':>14}{'ratio':>12}",
        *(
            f"{name:12}{row['reference_ms']:14.3f}{row['planner_ms']:14.3f}{row['ratio']:12.3f}"
            for name, row in rows.items()
        ),
    ])  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0, or 1 if a ratio is below its bound or the plans differ.

    Raises:
        ValueError: the device does not exist.
    """
    parser = make_parser("guard", __doc__)
    parser.add_argument("--samples", type=positive, help="rollouts of each instance")
    parser.add_argument("--threads", type=positive, default=1, help="CPU threads of the planner; the reference has one")
    parser.add_argument("--repeat", type=positive, default=10, help="number of plans to time")
    parser.add_argument("--bound", type=float, help=f"minimum ratio of the whole plan; by default {BOUNDS}")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args(arguments)
    try:
        result = compare_with_reference(
            *(config_of(preset, samples=options.samples) for preset in ("paper", "default")),
            device=options.device,
            points=options.points,
            threads=options.threads,
            repeat=options.repeat,
        )
    except PlansDifferError as error:
        print(error, file=sys.stderr)
        return 1
    bounds = dict(BOUNDS["cpu" if options.device == "cpu" else "cuda"])
    if options.bound is not None:
        bounds["plan"] = options.bound
    ratios = {name: row["ratio"] for name, row in _rows(result).items()}
    slow = [name for name, bound in bounds.items() if ratios[name] < bound]
    print(json.dumps(result | {"bounds": bounds, "slow": slow}) if options.json else _format_report(result))
    for name in slow:
        print(
            f"{name}: {ratios[name]:.2f} times as fast as the reference, {bounds[name]:g} times or more is expected: "
            "something has become slower.",
            file=sys.stderr,
        )
    return 1 if slow else 0


if __name__ == "__main__":
    run_command(main)
