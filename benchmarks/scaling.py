"""Measure how the time of a plan grows with samples K, steps N, instances M, the batch and the number of threads."""

from __future__ import annotations

import csv
import dataclasses
import json
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from aero_planner import Planner, PlannerConfig
from aero_planner.benchmark import elapsed_ms
from aero_planner.cli_util import run_command
from aero_planner.forest_cloud import forest_flight
from benchmarks.common import machine, make_parser, positive

_TOLERANCE = 1.1
"""Factor by which the time per state may exceed that of the smallest size before growth counts as superlinear."""


@dataclass(frozen=True)
class Row:
    """One size: M instances x K samples x N steps for B drones."""

    sweep: str
    instances: int
    samples: int
    steps: int
    batch: int
    threads: int | None
    least_ms: float
    median_ms: float
    p99_ms: float
    memory_mib: float | None
    """Peak device memory so far, on CUDA."""

    @property
    def work(self) -> int:
        """Number of sampled states of all drones, B M K N."""
        return self.instances * self.samples * self.steps * self.batch

    @property
    def nanoseconds(self) -> float:
        """Minimum time per sampled state [ns]; other processes can only add to it."""
        return 1e6 * self.least_ms / self.work


def _config(rows: int, columns: int, samples: int, steps: int) -> PlannerConfig:
    """Return a configuration with M anchors and no other candidates."""
    return PlannerConfig().replace(
        {
            "anchors.rows": rows, "anchors.columns": columns, "sampling.samples": samples, "sampling.steps": steps,
            "candidates.previous": False,
        }
    )  # fmt: skip


def time_plan(
    config: PlannerConfig, *, device: str, batch: int, threads: int | None, points: int, repeat: int
) -> tuple[float, float, float, float | None]:
    """Return minimum, median and 99th percentile of `Planner.launch` [ms], and the device's memory [MiB]."""
    planner = Planner(config, device=device, batch=batch, threads=threads)
    planner.plan(*forest_flight(points, batch))
    times = [elapsed_ms(planner.launch, device) for _ in range(repeat + 2)][2:]
    planner.close()
    warp_device = wp.get_device(device)
    memory = wp.get_mempool_used_mem_high(warp_device) / 2**20 if warp_device.is_cuda else None
    return min(times), float(np.median(times)), float(np.quantile(times, 0.99)), memory


def sweep(*, device: str, points: int, repeat: int, largest: int, batches: Sequence[int]) -> Iterator[Row]:
    """Measure K in 128..1024, N in 25, 50, M in 15, 45, the batch, and on the CPU one and all threads.

    Args:
        largest: M K N up to which sizes are measured.
        batches: drones planned at once.
    """

    def row(name: str, size: tuple[int, int], samples: int, steps: int, batch: int, threads: int | None) -> Row:
        config = _config(*size, samples, steps)
        ms = time_plan(config, device=device, batch=batch, threads=threads, points=points, repeat=repeat)
        return Row(name, size[0] * size[1], samples, steps, batch, threads, *ms)

    for size in ((3, 5), (5, 9)):
        for steps in (25, 50):
            for samples in (128, 256, 512, 1024):
                if size[0] * size[1] * samples * steps <= largest:
                    yield row("M K N", size, samples, steps, 1, None)
    for batch in batches:
        yield row("batch", (3, 5), 128, 25, batch, None)
    if wp.get_device(device).is_cpu:
        for threads in sorted({1, 2, os.cpu_count() or 1}):
            yield row("threads", (3, 5), 128, 25, 1, threads)
            yield row("threads", (3, 5), 512, 25, 1, threads)


def superlinear(rows: Sequence[Row], name: str) -> list[Row]:
    """Return the rows of a sweep whose time per state exceeds that of the smallest size."""
    own = sorted((row for row in rows if row.sweep == name), key=lambda row: row.work)
    return [row for row in own[1:] if row.nanoseconds > _TOLERANCE * own[0].nanoseconds]


def _verdict(rows: Sequence[Row], name: str) -> str:
    own = [row for row in rows if row.sweep == name]
    if len(own) < 2:
        return f"{name}: too few sizes to tell."
    faster = superlinear(rows, name)
    slope = float(np.polyfit(np.log([row.work for row in own]), np.log([row.least_ms for row in own]), 1)[0])
    growth = "grows FASTER than linearly" if faster else "grows no faster than linearly"
    sizes = ", ".join(f"M {row.instances} K {row.samples} N {row.steps} B {row.batch}" for row in faster)
    return f"{name}: the time {growth} in M K N B (exponent {slope:.2f}){': ' if faster else ''}{sizes}."


def _write(rows: Sequence[Row], folder: Path, about: dict[str, Any]) -> list[Path]:
    records = [dataclasses.asdict(row) | {"work": row.work, "ns_per_state": row.nanoseconds} for row in rows]
    with (folder / "scaling.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, records[0].keys())
        writer.writeheader()
        writer.writerows(records)
    (folder / "scaling.json").write_text(json.dumps({**about, "rows": records}, indent=1) + "\n", encoding="utf-8")
    files = [folder / "scaling.csv", folder / "scaling.json"]
    try:
        files.append(_plot(rows, folder / "scaling.png", f"{about['device']} ({about['machine']})"))
    except ImportError:
        print("no plot: matplotlib is not installed; pip install matplotlib draws it.", file=sys.stderr)
    return files


def _plot(rows: Sequence[Row], path: Path, subtitle: str) -> Path:
    from matplotlib.figure import Figure

    figure = Figure((8.0, 4.5), dpi=150, layout="constrained")
    axes = figure.add_subplot()
    axes.set_title(f"Time of a plan over its sampled states\n{subtitle}", fontsize=10)
    series: dict[str, list[Row]] = {}
    for row in rows:
        label = f"M = {row.instances}, N = {row.steps}, over K" if row.sweep == "M K N" else "M = 15, K = 128, over B"
        if row.sweep != "threads":
            series.setdefault(label, []).append(row)
    for label, own in series.items():
        axes.plot([row.work for row in own], [row.least_ms for row in own], marker="o", label=label)
    least = min(rows, key=lambda row: row.work)
    works = [row.work for row in rows]
    line = [least.least_ms * work / least.work for work in (min(works), max(works))]
    axes.plot([min(works), max(works)], line, color="gray", linestyle="--", label="linear")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("M K N B")
    axes.set_ylabel("least time [ms]")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    figure.savefig(path)
    return path


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0.

    Raises:
        ValueError: the device does not exist.
        OSError: the folder can't be written.
    """
    parser = make_parser("scaling", __doc__, points=20_000)
    parser.add_argument("--repeat", type=positive, default=10, help="number of plans to time per size")
    parser.add_argument("--largest", type=positive, default=45 * 1024 * 50, help="largest M K N to measure")
    parser.add_argument("--batch", type=positive, nargs="*", default=[1, 4, 16], help="drones planned at once")
    parser.add_argument("--output", type=Path, default=Path("results/scaling"), help="folder of CSV, JSON and plot")
    options = parser.parse_args(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    rows = []
    print(f"{options.device} ({machine(options.device)}), {options.points} points, {options.repeat} plans each")
    heads = ("K", "N", "batch", "threads", "least ms", "median ms", "p99 ms", "ns/state")
    print(f"{'sweep':7}{'M':>4}" + "".join(f"{head:>10}" for head in heads))
    for row in sweep(
        device=options.device, points=options.points, repeat=options.repeat, largest=options.largest,
        batches=options.batch,
    ):  # fmt: skip
        rows.append(row)
        size = (row.samples, row.steps, row.batch, row.threads or "all")
        times = (row.least_ms, row.median_ms, row.p99_ms, row.nanoseconds)
        cells = [f"{value:>10}" for value in size] + [f"{value:10.3f}" for value in times]
        print(f"{row.sweep:7}{row.instances:4}" + "".join(cells), flush=True)
    for name in dict.fromkeys(row.sweep for row in rows if row.sweep != "threads"):
        print(_verdict(rows, name))
    about = {"device": options.device, "machine": machine(options.device), "points": options.points}
    for path in _write(rows, options.output, about):
        print(path)
    return 0


if __name__ == "__main__":
    run_command(main)
