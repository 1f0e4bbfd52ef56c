"""Measure flights per minute in batches, also against another checkout.

    python -m benchmarks.flight_rate --device cuda:0 --against CHECKOUT

Flown are batches of forests, and a batch with as many worlds of each of the six fields of docs/agility.md. The time to
build a batch is not counted. The stages of a tick follow, 2 s after the start.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from aero_planner.cli_util import run_command
from benchmarks.agility import ROWS
from benchmarks.common import add_against, checkouts, machine, make_world, positive, run_in_checkout

_FIRST_SEED = 10_000
_PROGRAM = """
import json, statistics, sys, time
import warp as wp
from aero_viz.flight import FlightBatch, FlightRules
from aero_viz.scenes.world import World

path, device, sizes, time_limit = sys.argv[1], sys.argv[2], json.loads(sys.argv[3]), float(sys.argv[4])
worlds = [World(**json.loads(line)) for line in open(path, encoding="utf-8")]
rules = FlightRules(time_limit=time_limit)
rows = []

def batch_of(first, count):
    return FlightBatch(worlds[first : first + count], device=device, rules=rules)

batch_of(0, 1).run()  # loads the kernels
for first, count in sizes:
    batch = batch_of(first, count)
    wp.synchronize()
    started = time.perf_counter()
    results = batch.run()
    wp.synchronize()
    seconds = time.perf_counter() - started
    batch.planner.close()
    batch = batch_of(first, count)
    for _ in range(round(min(2.0, time_limit) / rules.period)):
        batch.step()
    stages = batch.time_stages(10)
    batch.planner.close()
    del batch
    arrived = sum(result.arrived for result in results)
    rows.append({"per_minute": 60.0 * count / seconds, "arrived": arrived, "stages": stages})
print(json.dumps(rows))
"""


def fly(root: Path, worlds: Path, device: str, batches: Sequence[tuple[int, int]], time_limit: float) -> Any:
    """Fly batches with the code of a checkout.

    Args:
        root: the checkout.
        worlds: file with one world per line, as JSON.
        device: "cpu" or a CUDA device.
        batches: first world and number of worlds of each batch.
        time_limit: rules.time_limit [s].

    Returns:
        For each batch "per_minute", the flights per minute, "arrived", their number, and "stages", the time of each
        stage of a tick [ms], see `FlightBatch.time_stages`.

    Raises:
        ValueError: the flights failed; the message is its last line.
    """
    return run_in_checkout(root, _PROGRAM, worlds, device, json.dumps(batches), time_limit)


def _write_worlds(path: Path, forests: int, worlds_per_field: int, processes: int) -> None:
    jobs = [("forest:100", _FIRST_SEED + i) for i in range(forests)]
    jobs += [(row, _FIRST_SEED + i) for row in ROWS for i in range(worlds_per_field)]
    with ProcessPoolExecutor(processes) as pool, path.open("w", encoding="utf-8") as file:
        for world in pool.map(make_world, *zip(*jobs, strict=True), chunksize=8):
            file.write(json.dumps(world.to_dict()) + "\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0.

    Raises:
        ValueError: as for `fly`, or --against is no checkout.
    """
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.flight_rate",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--device", default="cpu", help="cpu or cuda:0")
    parser.add_argument("--forests", type=positive, nargs="+", default=[256, 1024], help="sizes of the batches")
    parser.add_argument("--fields", type=positive, default=100, help="worlds of each of the six fields")
    parser.add_argument("--time-limit", type=float, default=60.0, help="rules.time_limit [s]")
    parser.add_argument("--processes", type=positive, default=os.cpu_count(), help="processes that make worlds")
    add_against(parser)
    options = parser.parse_args(arguments)
    roots = checkouts(options)
    forests, mixed = max(options.forests), len(ROWS) * options.fields
    batches = [(0, size) for size in options.forests] + [(forests, mixed)]
    names = [f"{size} forests" for size in options.forests] + [f"{mixed} in six fields"]
    print(f"{options.device} ({machine(options.device)})", flush=True)
    rates: list[list[float]] = []
    with tempfile.TemporaryDirectory() as folder:
        worlds = Path(folder) / "worlds.jsonl"
        _write_worlds(worlds, forests, options.fields, options.processes)
        for root in roots:
            flown = fly(root, worlds, options.device, batches, options.time_limit)
            rates.append([row["per_minute"] for row in flown])
            print(root)
            for name, row, (_, size) in zip(names, flown, batches, strict=True):
                stages = ", ".join(f"{stage} {ms:.2f}" for stage, ms in row["stages"].items())
                print(f"  {name}: {row['per_minute']:.0f} flights/min, {row['arrived']} of {size} arrived; {stages} ms")
    if len(rates) == 2:
        here, other = rates
        print("ratios: " + ", ".join(f"{name} {a / b:.2f}" for name, a, b in zip(names, here, other, strict=True)))
    return 0


if __name__ == "__main__":
    run_command(main)
