"""Measure the processor time of the plans of a forest flight on one CPU thread, also against another checkout."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from aero_planner.cli_util import run_command
from benchmarks.common import add_against, checkouts, positive, run_in_checkout

_PROGRAM = """
import json, sys, time
import aero_planner.planner
from aero_viz.flight import FlightSource
from aero_viz.scenes import scene
from aero_viz.session import Session

planner, times = aero_planner.planner.Planner, []
construct, plan = planner.__init__, planner.plan

def with_one_thread(self, *arguments, **options):
    construct(self, *arguments, **{**options, "threads": 1})

def timed(self, *arguments, **options):
    started = time.process_time()
    result = plan(self, *arguments, **options)
    times.append(1e3 * (time.process_time() - started))
    return result

planner.__init__, planner.plan = with_one_thread, timed
session = Session(FlightSource(scene("forest", seed=0), seed=0), seed=0)
for _ in range(int(sys.argv[1])):
    session.tick()
session.close()
print(json.dumps(times))
"""


def plan_times(root: Path, ticks: int) -> list[float]:
    """Return the processor time of each plan of a forest flight [ms], with the code of a checkout.

    Raises:
        ValueError: the flight failed; the message is its last line.
    """
    return run_in_checkout(root, _PROGRAM, ticks)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0.

    Raises:
        ValueError: as for `plan_times`, or --against is no checkout.
    """
    parser = argparse.ArgumentParser(prog="python -m benchmarks.flight_plans", description=__doc__)
    parser.add_argument("--ticks", type=positive, default=150, help="ticks of the flight, 20 ms each")
    add_against(parser)
    parser.add_argument("--repeat", type=positive, default=2, help="flights with each checkout, in turn")
    options = parser.parse_args(arguments)
    roots = checkouts(options)
    times: dict[Path, list[float]] = {root: [] for root in roots}
    for _ in range(options.repeat):
        for root in roots:
            flight = plan_times(root, options.ticks)
            times[root] += flight[len(flight) // 5 :]  # without the first plans, which load kernels
    for root, all_times in times.items():
        low, median, high = np.quantile(all_times, (0.1, 0.5, 0.9))
        print(f"{root}: median {median:.2f} ms, 10 to 90 % {low:.2f} to {high:.2f} ms, {len(all_times)} plans")
    if len(roots) == 2:
        ratio = np.median(times[roots[0]]) / np.median(times[roots[1]])
        print(f"ratio of the medians: {ratio:.2f}")
    return 0


if __name__ == "__main__":
    run_command(main)
