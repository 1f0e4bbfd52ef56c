"""Speed guard: compare the planner with the naive reference in one run, by ratios that hold on any machine."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from aero_planner import Planner, PlannerConfig
from aero_planner.benchmark import elapsed_ms
from aero_planner.cli_util import run_command
from aero_planner.forest_cloud import forest_flight
from benchmarks.common import config_of, machine, make_parser, positive
from benchmarks.naive import NEUTRAL, NaivePlanner

BOUNDS = {"cpu": {"plan": 40.0, "partition": 1.6, "rollouts": 4.0}, "cuda": {"plan": 1.2}}
"""Minimum ratios of the whole plan and of stages, by kind of device: about half of the measured values. The clearance,
which the naive reference finds by brute force, dominates the whole plan, hence the bounds on other stages."""

_WARM_UP = 2
_NOT_STAGES = ("inputs", "graph", "total")


class PlansDifferError(RuntimeError):
    """The naive and the current kernels plan differently."""


def compare_with_naive(
    config: PlannerConfig, *, device: str = "cpu", points: int = 200_000, threads: int | None = 1, repeat: int = 20
) -> dict[str, Any]:
    """Time naive and current kernels alternately, on the same plans.

    By default the planner has one thread, like the naive kernels, so the ratio does not depend on the number of cores.

    Returns:
        "stages": {name: {"naive_ms", "current_ms", "ratio"}}, None if one side has no stage of that name; stages are
        timed on the CPU only. "plan": the same for the whole plan, from the device inputs to the device outputs. Every
        time is the minimum of `repeat` times, since other processes can only add to it. And the arguments.

    Raises:
        ValueError: the device does not exist.
        PlansDifferError: naive and current kernels plan differently, so that their times say nothing.
    """
    planner = Planner(config, device=device, threads=threads)
    naive = NaivePlanner(planner)
    state, goal, cloud = forest_flight(points)
    stages: dict[str, tuple[list[float], list[float]]] = {}
    naive_ms, current_ms = [], []
    for i in range(_WARM_UP + repeat):
        naive.take_over()
        plan = planner.plan(state, goal, cloud)
        naive_time = elapsed_ms(naive.replay, device)
        if i == 0:
            _check_agreement(plan.fine_range, plan.best, naive.result())
        current_time = elapsed_ms(planner.launch, device)
        if i < _WARM_UP:
            continue
        naive_ms.append(naive_time)
        current_ms.append(current_time)
        # On CUDA the naive stages are one graph as well, and `stage_ms` is what its capture took.
        for side, times in enumerate((naive.stage_ms if device == "cpu" else {}, plan.stage_ms)):
            for name, milliseconds in times.items():
                if name not in _NOT_STAGES:
                    stages.setdefault(name, ([], []))[side].append(milliseconds)
    planner.close()
    return {
        "device": device,
        "machine": machine(device),
        "points": points,
        "samples": config.sampling.samples,
        "steps": config.sampling.steps,
        "instances": len(config.kinds),
        "threads": threads,
        "repeat": repeat,
        "stages": {name: _row(*times) for name, times in stages.items()},
        "plan": _row(naive_ms, current_ms),
    }


def _check_agreement(fine_range: Any, best: Any, naive: dict[str, Any]) -> None:
    if not np.array_equal(fine_range.ravel(), naive["fine_range"][0]) or best != naive["best"][0]:
        raise PlansDifferError(
            "naive and current kernels plan differently, so their times can't be compared; "
            "run tests/benchmarks/test_naive.py to see where they differ."
        )


def _row(naive: Sequence[float], current: Sequence[float]) -> dict[str, float | None]:
    naive_ms, current_ms = (min(times) if times else None for times in (naive, current))
    ratio = naive_ms / current_ms if naive_ms and current_ms else None
    return {"naive_ms": naive_ms, "current_ms": current_ms, "ratio": ratio}


def _format_report(result: dict[str, Any]) -> str:
    def cell(value: float | None) -> str:
        return f"{'-':>12}" if value is None else f"{value:12.3f}"

    lines = [
        f"{result['device']} ({result['machine']}), {result['points']} points, {result['instances']} instances x "
        f"{result['samples']} samples x {result['steps']} steps, threads {result['threads']}, {result['repeat']} plans",
        f"{'':12}{'naive ms':>12}{'current ms':>12}{'ratio':>12}",
    ]
    rows = {**result["stages"], "plan": result["plan"]}
    lines += [
        f"{name:12}{cell(row['naive_ms'])}{cell(row['current_ms'])}{cell(row['ratio'])}" for name, row in rows.items()
    ]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0, or 1 if a ratio is below its bound or the plans differ.

    Raises:
        ValueError: the device or the configuration does not exist.
    """
    parser = make_parser("guard", __doc__)
    parser.add_argument("--samples", type=positive, help="rollouts of each instance")
    parser.add_argument("--preset", default="default", help="preset or configuration file")
    parser.add_argument(
        "--threads", type=positive, default=1, help="CPU threads of the planner; naive kernels have one"
    )
    parser.add_argument("--repeat", type=positive, default=20, help="number of plans to time")
    parser.add_argument("--bound", type=float, help=f"minimum ratio of the whole plan; by default {BOUNDS}")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args(arguments)
    config = config_of(options.preset, samples=options.samples).replace(NEUTRAL)
    try:
        result = compare_with_naive(
            config, device=options.device, points=options.points, threads=options.threads, repeat=options.repeat
        )
    except PlansDifferError as error:
        print(error, file=sys.stderr)
        return 1
    bounds = dict(BOUNDS["cpu" if options.device == "cpu" else "cuda"])
    if options.bound is not None:
        bounds["plan"] = options.bound
    ratios = {name: row["ratio"] for name, row in ({"plan": result["plan"]} | result["stages"]).items()}
    slow = [name for name, bound in bounds.items() if (ratios.get(name) or np.inf) < bound]
    print(json.dumps(result | {"bounds": bounds, "slow": slow}) if options.json else _format_report(result))
    for name in slow:
        print(
            f"{name}: {ratios[name]:.2f} times as fast as the naive reference, {bounds[name]:g} times or more is "
            "expected: something has become slower.",
            file=sys.stderr,
        )
    return 1 if slow else 0


if __name__ == "__main__":
    run_command(main)
