"""Measure what Ray costs and gains: the same flights in this process and on 1, 2 and 4 workers of this machine."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Sequence
from functools import partial

from aero_planner.cli_util import run_command
from aero_viz.evaluation.executor import Executor, LocalExecutor, RayExecutor
from aero_viz.flight import FlightBatch, FlightRules
from aero_viz.scenes import scene
from benchmarks.common import machine, make_parser, positive


def fly(limit: float, seed: int, progress: object) -> float:
    """Fly through a forest on one thread for at most `limit` [s]; return the CPU time [s]."""
    started = time.process_time()
    batch = FlightBatch([scene("forest", seed=seed)], seed=seed, threads=1, rules=FlightRules(time_limit=limit))
    batch.run()
    batch.planner.close()
    return time.process_time() - started


def measure(executor: Executor, workers: int, flights: int, limit: float) -> tuple[float, float, float]:
    """Return the time until all workers have flown, the wall time of all flights, and their CPU time [s]."""
    times = [time.perf_counter()]
    list(executor.map(partial(fly, 0.02), range(4 * workers)))  # imports, and loads the kernels
    times.append(time.perf_counter())
    cpu = sum(cpu for _, cpu in executor.map(partial(fly, limit), range(flights)))
    return times[1] - times[0], time.perf_counter() - times[1], cpu


def _row(workers: int, flights: int, limit: float) -> tuple[float, float, float]:
    if not workers:
        return measure(LocalExecutor(), 1, flights, limit)
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": workers})
    executor = RayExecutor(cluster.address)
    try:
        return measure(executor, workers, flights, limit)
    finally:
        executor.close()
        cluster.shutdown()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0."""
    parser = make_parser("ray_workers", __doc__)
    parser.add_argument("--flights", type=positive, default=12, help="flights per repetition")
    parser.add_argument("--limit", type=float, default=2.0, help="simulated duration of a flight [s]")
    parser.add_argument("--repeat", type=positive, default=5, help="repetitions")
    options = parser.parse_args(arguments)
    cores, alone = os.cpu_count() or 1, 0.0
    print(f"{machine('cpu')}, {cores} cores, {options.flights} flights, medians (ranges) of {options.repeat}")
    print("| workers | start [s] | wall [s] | CPU per flight [s] | speed-up | per core |\n|" + " --- |" * 6, flush=True)
    for n in (0, 1, 2, 4):
        starts, walls, cpus = zip(
            *(_row(n, options.flights, options.limit) for _ in range(options.repeat)), strict=True
        )
        alone = alone or statistics.median(walls)
        speed = [alone / wall for wall in walls]
        figures = (
            starts,
            walls,
            [cpu / options.flights for cpu in cpus],
            speed,
            [v / min(max(n, 1), cores) for v in speed],
        )
        cells = [f"{statistics.median(v):.2f} ({min(v):.2f} to {max(v):.2f})" for v in figures]
        print(f"| {' | '.join([str(n or 'without Ray'), *cells])} |", flush=True)
    return 0


if __name__ == "__main__":
    run_command(main)
