"""Lower bounds on the time of each stage, from floating-point operations, bytes and dependent results.

A floor follows from the equations of a stage, not from their implementation: every operation once at the peak rate of
the machine, only the bytes that enter and leave the stage, and the longest chain of dependent operations at full clock.
The clearance counts one look-up and one distance per position. Kernel launches are not counted.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from aero_planner import Planner, PlannerConfig
from aero_planner.benchmark import elapsed_ms
from aero_planner.cli_util import run_command
from aero_planner.forest_cloud import forest_flight
from aero_planner.kernels.guides import BRAKING_FAN
from aero_planner.kernels.mppi import PROBES
from benchmarks.common import config_of, machine, make_parser, positive
from benchmarks.operations import Latency, nominal_controls, partition_point, rollout


@dataclass(frozen=True)
class Machine:
    """Peak figures of a processor, or of one core if `per_core`."""

    operations: float
    """Single-precision operations per second; a fused product and sum counts as two."""
    bytes: float
    """Bytes from and to memory per second."""
    clock: float
    """Clock frequency [Hz]."""
    latency: Latency
    memory: int
    """Latency of the second-level cache [cycles]."""
    per_core: bool
    source: str


_HOPPER = Latency(arithmetic=4, special=20)
"""Dependent arithmetic: 4 cycles since Volta (CUDA C++ Programming Guide, multiprocessor level). The special function
unit's is not published; 20 is an estimate, and 10 more would move a rollout's floor by a fifth."""

MACHINES = {
    "h100": Machine(
        66.9e12, 3.35e12, 1.98e9, _HOPPER, 262, False,
        "NVIDIA H100 SXM datasheet: 67 TFLOP/s, 3.35 TB/s; 132 x 128 x 2 x 1.98 GHz; L2 by arXiv 2402.13499",
    ),
    "h200": Machine(
        66.9e12, 4.8e12, 1.98e9, _HOPPER, 262, False,
        "NVIDIA H200 datasheet: 67 TFLOP/s, 4.8 TB/s; cores, clock and L2 as the H100's",
    ),
    "cpu": Machine(
        32 * 3.7e9, 20e9, 3.7e9, Latency(arithmetic=4, special=15), 14, True,
        "one core of AMD Zen 4 (EPYC 9004): two fused 256-bit operations per cycle, 3.7 GHz boost, 4 cycles, L2 14 "
        "cycles (AMD software optimization guide 57647); 20 GB/s per core is an estimate",
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Floor:
    """Lower bound on the time of one stage."""

    operations: float
    bytes: float
    cycles: float

    def parts_us(self, machine: Machine, threads: int) -> tuple[float, float, float]:
        """Return the times of operations, bytes and latency [us]."""
        cores = threads if machine.per_core else 1
        return (
            1e6 * self.operations / (cores * machine.operations),
            1e6 * self.bytes / (cores * machine.bytes),
            1e6 * self.cycles / machine.clock,
        )


def floors(config: PlannerConfig, machine: Machine, *, points: int, kept: int, batch: int = 1) -> dict[str, Floor]:
    """Return the floor of each stage, for P points of which `kept` remain."""
    M, N, K = len(config.kinds), config.sampling.steps, config.sampling.samples
    cells = int(np.prod(config.fine_shape))
    latency = machine.latency
    sampled, final = rollout(latency, N), rollout(latency, N, noisy=False)
    guided, point = nominal_controls(latency, N), partition_point(latency)
    rows = N + (int(PROBES) if config.costs.q_blocked > 0.0 else 0)
    stopping = M + int(BRAKING_FAN)
    # Per position: its cell of the grid, one distance and its cost.
    position = 9 + 8 + 6
    look_up = 2 * machine.memory + 5 * latency.arithmetic + latency.special
    # A tree of minima, the weights, a tree of sums, and a tree over the weighted noise.
    tree = int(np.ceil(np.log2(max(K, 2)))) * latency.arithmetic
    per_drone = {
        "partition": Floor(points * point.operations, 12 * points + 4 * cells + 12 * kept, point.cycles
                           + 2 * machine.memory),
        "guides": Floor(M * guided.operations, M * (2 * N + 1) * 16, guided.cycles),
        "rollouts": Floor(M * K * sampled.operations, M * N * 28 + M * K * 4, sampled.cycles),
        "clearance": Floor(M * K * rows * position, 12 * kept + M * K * 4, look_up),
        "update": Floor(M * K * (4 + 12 * N), M * K * 4 + M * N * 32, 3 * tree + 2 * latency.special),
        # Includes the braking candidates and the midpoints between states.
        "stage2": Floor(
            stopping * (final.operations + (rows + N) * position), stopping * N * (16 + 40), final.cycles + look_up,
        ),
    }  # fmt: skip
    return {
        name: Floor(batch * floor.operations, batch * floor.bytes, floor.cycles) for name, floor in per_drone.items()
    }


_PART_OF = {"anchors": "guides", "grid": "clearance"}
"""Stages that the planner times separately, by the stage whose floor includes them."""


def _measure(
    config: PlannerConfig, device: str, points: int, batch: int, threads: int | None, repeat: int
) -> tuple[dict[str, float], float, int]:
    """Return the minimum time of each stage and of `launch` [us], and the size of the filtered cloud."""
    planner = Planner(config, device=device, batch=batch, threads=threads)
    state, goal, cloud = forest_flight(points, batch)
    stages: dict[str, list[float]] = {}
    launches = []
    kept = 0
    for i in range(repeat + 2):
        plan = planner.plan(state, goal, cloud)
        milliseconds = elapsed_ms(planner.launch, device)
        kept = len(plan.filtered_points[0])
        if i >= 2:
            launches.append(milliseconds)
            for name, value in plan.stage_ms.items():
                stages.setdefault(name, []).append(value)
    if device != "cpu":
        stages = planner.time_stages(repeat)
    planner.close()
    least: dict[str, float] = {}
    for name, values in stages.items():
        if name not in ("inputs", "graph", "total"):
            owner = _PART_OF.get(name, name)
            least[owner] = least.get(owner, 0.0) + 1e3 * min(values)
    return least, 1e3 * min(launches), kept


def _report(result: dict[str, Any]) -> str:
    def cell(value: float | None, width: int = 12) -> str:
        return f"{'-':>{width}}" if value is None else f"{value:{width}.2f}"

    heads = ("Mop", "KiB", "cycles", "op us", "bytes us", "latency us", "floor us", "measured us", "times")
    lines = [
        f"{result['device']} ({result['machine']}), {result['points']} points, {result['kept']} kept, batch "
        f"{result['batch']}, {result['instances']} instances x {result['samples']} samples x {result['steps']} steps, "
        f"threads {result['threads']}",
        f"floor of {result['floor_of']}: {MACHINES[result['floor_of']].source}",
        f"{'':10}" + "".join(f"{head:>12}" for head in heads),
    ]
    for name, row in result["stages"].items():
        lines.append(f"{name:10}" + "".join(cell(row[head]) for head in heads))
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0.

    Raises:
        ValueError: device or configuration does not exist.
    """
    parser = make_parser("floors", __doc__)
    parser.add_argument("--floor-of", choices=sorted(MACHINES), help="processor; otherwise by the device")
    parser.add_argument("--samples", type=positive, help="rollouts of each instance")
    parser.add_argument("--steps", type=positive, help="steps of the horizon")
    parser.add_argument("--batch", type=positive, default=1, help="drones planned at once")
    parser.add_argument("--threads", type=positive, default=1, help="CPU threads")
    parser.add_argument("--preset", default="default", help="preset or configuration file")
    parser.add_argument("--repeat", type=positive, default=20, help="plans to time")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args(arguments)
    config = config_of(options.preset, samples=options.samples, steps=options.steps)
    measured, launch, kept = _measure(
        config, options.device, options.points, options.batch, options.threads, options.repeat
    )
    name = machine(options.device)
    floor_of = options.floor_of or ("cpu" if options.device == "cpu" else "h200" if "H200" in name else "h100")
    processor = MACHINES[floor_of]
    is_measured = floor_of == ("cpu" if options.device == "cpu" else floor_of)
    rows: dict[str, Any] = {}
    total = 0.0
    for stage, floor in floors(config, processor, points=options.points, kept=kept, batch=options.batch).items():
        parts = floor.parts_us(processor, options.threads)
        total += max(parts)
        time_us = measured.pop(stage, None) if is_measured else None
        rows[stage] = {
            "Mop": floor.operations / 1e6, "KiB": floor.bytes / 1024, "cycles": floor.cycles, "op us": parts[0],
            "bytes us": parts[1], "latency us": parts[2], "floor us": max(parts), "measured us": time_us,
            "times": time_us / max(parts) if time_us else None,
        }  # fmt: skip
    empty = dict.fromkeys(rows["stage2"])
    if is_measured:  # stages under other names
        rows |= {stage: empty | {"measured us": time_us} for stage, time_us in measured.items()}
    rows["plan"] = empty | {"floor us": total}
    if is_measured:
        rows["plan"] |= {"measured us": launch, "times": launch / total}
    result = {
        "device": options.device, "machine": name, "floor_of": floor_of, "points": options.points, "kept": kept,
        "batch": options.batch, "threads": options.threads, "instances": len(config.kinds),
        "samples": config.sampling.samples, "steps": config.sampling.steps, "stages": rows,
    }  # fmt: skip
    print(json.dumps(result) if options.json else _report(result))
    return 0


if __name__ == "__main__":
    run_command(main)
