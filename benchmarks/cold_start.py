"""Measure the time from the import of the planner to the first plan, with and without compiled kernels."""

from __future__ import annotations

import json
import os
import resource
import tempfile
from collections.abc import Sequence
from typing import Any

from aero_planner.cli_util import run_command
from benchmarks.common import machine, make_parser, run_program

_PROGRAM = """
import json, sys, time
started = time.perf_counter()
from aero_planner import Goal, Planner, VehicleState
imported = time.perf_counter()
planner = Planner(device=sys.argv[1])
built = time.perf_counter()
from aero_planner.forest_cloud import forest_cloud
cloud = forest_cloud(int(sys.argv[2]))
generated = time.perf_counter()
planner.plan(VehicleState([0, 0, 2], [4, 0, 0], [1, 0, 0, 0]), Goal([30, 0, 2]), cloud)
planned = time.perf_counter()
print(json.dumps({"import_s": imported - started, "planner_s": built - imported, "plan_s": planned - generated}))
"""


def first_plan(cache: str, *, device: str = "cpu", points: int = 200_000) -> dict[str, float]:
    """Import the planner, build it and plan once in a new process, with Warp's cache in the folder `cache`.

    Returns:
        "import_s", "planner_s" (in which kernels are compiled and loaded), "plan_s" and their sum, "total_s"; "cpu_s",
        the processor time of the whole process, on which other processes have little influence.

    Raises:
        ValueError: the process failed; the message is its last line.
    """
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = {"WARP_CACHE_PATH": cache}
    times: dict[str, float] = run_program(
        _PROGRAM, device, points, failure="the planner did not start", environment=environment
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {**times, "total_s": sum(times.values()), "cpu_s": cpu}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0.

    Raises:
        ValueError: as for `first_plan`.
    """
    parser = make_parser("cold_start", __doc__)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args(arguments)
    rows: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as cache:
        for name in ("empty cache", "warm cache"):
            rows[name] = first_plan(cache, device=options.device, points=options.points)
    if options.json:
        print(json.dumps({"device": options.device, "machine": machine(options.device), **rows}))
        return 0
    print(f"{options.device} ({machine(options.device)}), {os.cpu_count()} cores, {options.points} points")
    keys = ("import_s", "planner_s", "plan_s", "total_s", "cpu_s")
    print(f"{'':14}" + "".join(f"{key.replace('_', ' '):>11}" for key in keys))
    for name, row in rows.items():
        print(f"{name:14}" + "".join(f"{row[key]:11.2f}" for key in keys))
    return 0


if __name__ == "__main__":
    run_command(main)
