"""Time one MPPI problem with this planner, pytorch_mppi and jax_mppi in one run.

Dynamics, horizon, samples, costs and cloud are the same. The time of the planner is that of its whole plan, starting
from 200 000 points. The time of a library is that of sampling, rollouts, costs and update for a given filtered cloud.
"""

from __future__ import annotations

import importlib
import json
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import warp as wp

from aero_planner import Planner
from aero_planner.cli_util import installed_version, run_command
from aero_planner.forest_cloud import forest_flight
from benchmarks.common import machine, make_parser, positive
from benchmarks.comparison.problem import Problem, make_problem, problem_config

LIBRARIES = {"pytorch-mppi": "benchmarks.comparison.with_torch", "jax-mppi": "benchmarks.comparison.with_jax"}
"""Module of each distribution; both are in the extra `bench`."""


def planner_runner(problem: Problem, device: str, points: int) -> Callable[[], None]:
    """Return a function that plans once from the cloud on the device."""
    planner = Planner(problem.config, device=device)
    state, goal, cloud = forest_flight(points)
    planner.plan(state, goal, cloud)

    def run() -> None:
        planner.launch()
        wp.synchronize_device(device)

    return run


def compare(
    *, device: str = "cpu", points: int = 200_000, samples: int = 128, repeat: int = 5, missing: Callable[[str], None]
) -> dict[str, Any]:
    """Time every library in turn, with 15 instances of `samples` and with one of 15 times as many.

    Args:
        missing: called with a sentence for each library that can't be compared.

    Returns:
        {"cases": {case: {library: {"ms", "ratio"}}}, "versions": .., and the arguments}. "ms" is the minimum of
        `repeat` times, since other processes can only add to it; "ratio" is its ratio to the planner's.
    """
    modules: dict[str, Any] = {}
    for name, module in LIBRARIES.items():
        try:
            modules[name] = importlib.import_module(module)
        except (ImportError, OSError) as error:
            newer = ", on Python 3.12 or newer," if name == "jax-mppi" else ""
            missing(f"{name} is left out: {error}; install it{newer} with: pip install -e '.[bench]'")
    cases = {}
    for instances, count in (((5, 3), samples), ((1, 1), 15 * samples)):
        case = f"{instances[0] * instances[1]} x {count}"
        problem = make_problem(problem_config(instances, count), points, device)
        runners = {"aero-planner": planner_runner(problem, device, points)}
        for name, module in list(modules.items()):
            try:
                runners[name] = module.make_runner(problem, device)
                runners[name]()  # compiles
            except Exception as error:  # a library may raise anything if the device is missing
                missing(f"{name} is left out: it can't run on {device}: {str(error).splitlines()[0]}")
                runners.pop(name, None)
                del modules[name]
        times: dict[str, list[float]] = {name: [] for name in runners}
        for i in range(repeat + 1):  # the first run warms up
            for name, run in runners.items():
                started = time.perf_counter()
                run()
                if i > 0:
                    times[name].append(1e3 * (time.perf_counter() - started))
        least = {name: min(values) for name, values in times.items()}
        cases[case] = {name: {"ms": ms, "ratio": ms / least["aero-planner"]} for name, ms in least.items()}
    return {
        "device": device,
        "machine": machine(device),
        "points": points,
        "repeat": repeat,
        "versions": {name: installed_version(name) for name in ("aero-planner", "warp-lang", *modules)},
        "cases": cases,
    }


def _report(result: Any) -> str:
    versions = ", ".join(f"{name} {version}" for name, version in result["versions"].items())
    lines = [
        f"{result['device']} ({result['machine']}), {result['points']} points, {result['repeat']} runs; {versions}"
    ]
    lines.append(f"{'instances x samples':22}{'library':16}{'ms':>12}{'ratio':>10}")
    for case, rows in result["cases"].items():
        lines += [f"{case:22}{name:16}{row['ms']:12.2f}{row['ratio']:10.1f}" for name, row in rows.items()]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0.

    Raises:
        ValueError: the device does not exist.
    """
    parser = make_parser("compare", __doc__)
    parser.add_argument("--samples", type=positive, default=128, help="rollouts of each of the 15 instances")
    parser.add_argument("--repeat", type=positive, default=5, help="number of runs to time")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args(arguments)
    result = compare(
        device=options.device, points=options.points, samples=options.samples, repeat=options.repeat,
        missing=lambda sentence: print(sentence, file=sys.stderr),
    )  # fmt: skip
    print(json.dumps(result) if options.json else _report(result))
    return 0


if __name__ == "__main__":
    run_command(main)
