"""Measure how long the planner takes on this machine: `python -m aero_planner.benchmark --help`."""

from __future__ import annotations

import itertools
import json
import resource
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from aero_planner.cli_util import Parser, run_command
from aero_planner.config import PlannerConfig
from aero_planner.config.file import config_from_name
from aero_planner.forest_cloud import forest_flight
from aero_planner.plain_text import say
from aero_planner.plan import Goal, VehicleState
from aero_planner.planner import Planner
from aero_planner.sweeps import Arrival, Sweeps, as_constant

_WARM_UP = 3
_SWEEPS = 10
_SWEEPS_REMEMBERED = 30
"""Sweeps in the memory of a flight: of those before the newest `_SWEEPS`, one point in `THINNING` is kept."""
_PLANS_PER_SWEEP = 5
_SWEEP_PERIOD = 0.1
_SWEEP_ROWS = ("sweeps", "sweeps, inputs", "new sweep", "new sweep, inputs")
_MIB = 2.0**20


def measure(
    config: PlannerConfig,
    *,
    device: str = "cpu",
    batch: int = 1,
    points: int = 200_000,
    threads: int | None = None,
    repeat: int = 100,
    seed: int = 0,
) -> dict[str, Any]:
    """Time the planner in a forest at 4 m/s.

    Args:
        config: parameters.
        device, threads: as for `Planner`.
        batch: number of drones, all in the same situation.
        points: number of points of each cloud.
        repeat: number of plans to time.
        seed: seed of the forest and of the noise.

    Returns:
        "plan": {"median_ms", "p99_ms"} of `Planner.plan`, with the joined cloud in host memory and all results copied
            back;
        "sweeps": the same with `Sweeps` as in a flight, of which every fifth plan gets a new one, as at 50 Hz from a
            LiDAR with 10 Hz; one drone only;
        "new sweep": the same for these fifth plans;
        "sweeps, inputs" and "new sweep, inputs": the part of these times before the launches begin;
        "launch": the same for `Planner.launch`, with everything on the device;
        "stages": the same for each stage; on CUDA, stages run one after another here, with an event between them;
        "plans_per_second" and "launches_per_second", over the batch;
        "points_kept": size of the filtered cloud, per drone;
        "memory_mib": growth of the resident set on the CPU, device memory on CUDA;
        and the arguments.

    Raises:
        ValueError: an argument is out of its range, or the device does not exist.
    """
    for name, value, minimum in (("points", points, 0), ("repeat", repeat, 1)):
        if value < minimum:
            raise ValueError(f"{name} is {value}; it must be at least {minimum}.")
    state, goal, cloud = forest_flight(points, None if batch == 1 else batch, seed=seed)
    resident_before = _resident_bytes()
    planner = Planner(config, device=device, seed=seed, batch=None if batch == 1 else batch, threads=threads)
    warp_device = wp.get_device(device)
    free_before = warp_device.free_memory if warp_device.is_cuda else 0
    stages: dict[str, list[float]] = {}
    kept = 0.0
    for i in range(repeat + _WARM_UP):
        plan = planner.plan(state, goal, cloud)
        if i >= _WARM_UP:
            for name, milliseconds in plan.stage_ms.items():
                stages.setdefault(name, []).append(milliseconds)
        clouds = plan.filtered_points if isinstance(plan.filtered_points, list) else [plan.filtered_points]
        kept = sum(map(len, clouds)) / batch
    launches = [elapsed_ms(planner.launch, device) for _ in range(repeat + _WARM_UP)][_WARM_UP:]
    if warp_device.is_cuda:
        stages |= planner.time_stages(repeat)
    sweeps = _time_sweeps(planner, state, goal, cloud, repeat) if isinstance(cloud, np.ndarray) else {}
    planner.close()

    if warp_device.is_cuda and wp.is_mempool_enabled(warp_device):
        memory = wp.get_mempool_used_mem_high(warp_device)
    elif warp_device.is_cuda:
        memory = free_before - warp_device.free_memory
    else:
        memory = _resident_bytes() - resident_before
    total = stages.pop("total")
    return {
        "device": device,
        "device_name": warp_device.name,
        "batch": batch,
        "points": points,
        "samples": config.sampling.samples,
        "steps": config.sampling.steps,
        "instances": len(config.kinds),
        "threads": threads,
        "repeat": repeat,
        "stages": {name: _summarize(times) for name, times in stages.items()},
        "plan": _summarize(total),
        **{name: _summarize(sweeps[name]) if sweeps else None for name in _SWEEP_ROWS},
        "launch": _summarize(launches),
        "plans_per_second": 1e3 * batch / float(np.median(total)),
        "launches_per_second": 1e3 * batch / float(np.median(launches)),
        "points_kept": kept,
        "memory_mib": memory / _MIB,
    }


def elapsed_ms(work: Callable[[], Any], device: str) -> float:
    """Return the time of `work` [ms], on CUDA between two events of the device's stream."""
    warp_device = wp.get_device(device)
    if not warp_device.is_cuda:
        started = time.perf_counter()
        work()
        return 1e3 * (time.perf_counter() - started)
    with wp.ScopedDevice(warp_device):
        begin, end = wp.Event(warp_device, enable_timing=True), wp.Event(warp_device, enable_timing=True)
        wp.record_event(begin)
        work()
        wp.record_event(end)
        return float(wp.get_event_elapsed_time(begin, end))


def _time_sweeps(
    planner: Planner[Any], state: VehicleState, goal: Goal, cloud: NDArray[Any], repeat: int
) -> dict[str, list[float]]:
    """Return the times of plans with sweeps that arrive one after another [ms], by the names of `_SWEEP_ROWS`."""
    arriving = itertools.cycle(as_constant(part) for part in np.array_split(cloud, _SWEEPS))
    sweeps = Sweeps(itertools.islice(arriving, _SWEEPS_REMEMBERED), whole=_SWEEPS)
    x, y, z = map(float, np.asarray(state.position))
    times: list[float] = []
    inputs: list[float] = []
    for i in range(repeat + _PLANS_PER_SWEEP * _WARM_UP):
        started = time.perf_counter()
        if i % _PLANS_PER_SWEEP == 0:
            arrival = Arrival(_SWEEP_PERIOD * (i // _PLANS_PER_SWEEP), (x, y, z))
            sweeps = sweeps.add(next(arriving), limit=_SWEEPS_REMEMBERED, arrival=arrival)
        begun = time.perf_counter()
        plan = planner.plan(state, goal, sweeps)
        times.append(1e3 * (time.perf_counter() - started))
        inputs.append(1e3 * (begun - started) + plan.stage_ms["inputs"])
    first = _PLANS_PER_SWEEP * _WARM_UP
    rows = times[first:], inputs[first:], times[first::_PLANS_PER_SWEEP], inputs[first::_PLANS_PER_SWEEP]
    return dict(zip(_SWEEP_ROWS, rows, strict=True))


def _summarize(times: Sequence[float]) -> dict[str, float]:
    return {"median_ms": float(np.median(times)), "p99_ms": float(np.quantile(times, 0.99))}


def _resident_bytes() -> int:
    """Return the peak resident set of this process [bytes]; Linux reports KiB, macOS bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def _format_report(result: dict[str, Any], preset: str) -> str:
    lines = [
        f"{result['device']} ({result['device_name']}), preset {preset}, batch {result['batch']}, "
        f"{result['points']} points, {result['instances']} instances x {result['samples']} samples x "
        f"{result['steps']} steps, {result['repeat']} plans",
        f"{'':20}{'median ms':>12}{'p99 ms':>12}",
    ]
    whole_plans = {name: result[name] for name in ("plan", *_SWEEP_ROWS, "launch") if result[name]}
    rows = {**result["stages"], **whole_plans}
    lines += [f"{name:20}{row['median_ms']:12.3f}{row['p99_ms']:12.3f}" for name, row in rows.items()]
    lines += [
        f"plans per second: {result['plans_per_second']:.1f} with host copies, "
        f"{result['launches_per_second']:.1f} on the device alone",
        f"points kept: {result['points_kept']:.0f} per drone; memory: {result['memory_mib']:.0f} MiB",
    ]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code: 0, or 2 for a wrong argument."""
    parser = Parser(prog="python -m aero_planner.benchmark", description=__doc__)
    parser.add_argument("--device", default="cpu", help="cpu or cuda:0")
    parser.add_argument("--batch", type=int, default=1, help="number of drones planned at once")
    parser.add_argument("--points", type=int, default=200_000, help="points of each cloud")
    parser.add_argument("--samples", type=int, help="rollouts of each instance")
    parser.add_argument("--steps", type=int, help="time steps of the horizon")
    parser.add_argument("--preset", default="default", help="preset or configuration file")
    parser.add_argument("--threads", type=int, help="CPU threads; by default one per core")
    parser.add_argument("--repeat", type=int, default=100, help="number of plans to time")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args(arguments)
    changes = {"sampling.samples": options.samples, "sampling.steps": options.steps}
    try:
        config = config_from_name(options.preset).replace({k: v for k, v in changes.items() if v is not None})
        result = measure(
            config, device=options.device, batch=options.batch, points=options.points, threads=options.threads,
            repeat=options.repeat,
        )  # fmt: skip
    except ValueError as error:
        say(error, file=sys.stderr)
        return 2
    say(json.dumps({"preset": options.preset, **result}) if options.json else _format_report(result, options.preset))
    return 0


if __name__ == "__main__":
    run_command(main)
