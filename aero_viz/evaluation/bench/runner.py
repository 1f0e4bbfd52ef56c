"""Flying a benchmark in batches. The results of a batch are written as soon as it is finished."""

from __future__ import annotations

import dataclasses
import datetime
import json
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Any

from aero_planner import PlannerConfig
from aero_viz.errors import UserError
from aero_viz.evaluation.batching import Progress, batch_progress, default_batch
from aero_viz.evaluation.bench.machine import hardware, versions
from aero_viz.evaluation.bench.result_folder import append_flights, open_folder
from aero_viz.evaluation.bench.suites import Benchmark, Row
from aero_viz.flight import FlightBatch, FlightRules, StateNoise, VehicleModel
from aero_viz.scenes import World, scene
from aero_viz.scenes.passable import is_passable
from aero_viz.sensors import LidarModel, lidar_model

__all__ = ["BenchmarkInterrupted", "Run", "run_benchmark"]


@dataclass(frozen=True)
class Run:
    """The flights of a benchmark so far."""

    benchmark: Benchmark
    header: dict[str, Any]
    """Everything that the results depend on (seed, configuration, versions), the hardware and the date."""
    flights: list[dict[str, Any]]
    """One record per flight: the fields of `FlightResult`, row, index, world_seed, passable, and of its batch batch,
    batch_size, build_s and run_s."""

    @property
    def total(self) -> int:
        """Number of flights of the whole benchmark."""
        return sum(row.batch or self.header["flights"] for row in self.benchmark.rows)

    @property
    def is_complete(self) -> bool:
        """True if no flight is missing."""
        return len(self.flights) == self.total


class BenchmarkInterrupted(KeyboardInterrupt):
    """Ctrl-C during the flights of a benchmark. The flights that had finished are written and in `run`."""

    def __init__(self, run: Run) -> None:
        super().__init__()
        self.run = run


@dataclass(frozen=True)
class _PlannedFlight:
    """One flight that has not been flown yet."""

    row: Row
    index: int
    seed: int
    """Seed of LiDAR and planner. Seeds are consecutive in the order of flying, as a batch requires."""
    world_seed: int
    config: PlannerConfig
    vehicle: VehicleModel
    rules: FlightRules
    group: tuple[Any, ...]
    """Flights can share a batch if their groups are equal."""


def run_benchmark(
    benchmark: Benchmark,
    output: str | Path,
    *,
    flights: int = 50,
    seed: int = 0,
    config: PlannerConfig | None = None,
    config_name: str = "default",
    device: str = "cpu",
    lidar: str | None = None,
    batch: int | None = None,
    resume: bool = False,
    rules: FlightRules | None = None,
    noise: StateNoise | None = None,
    drone: Mapping[str, float] | None = None,
    sensor: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> Run:
    """Fly the flights of a benchmark that are not in the folder `output` yet, and return all of its flights.

    World i of each row has the seed `seed` + i. The seeds of LiDAR and planner are `seed`, `seed` + 1, .. in the order
    of flying, so that batches of any size give the same results. The results of a batch are written when it is finished
    or interrupted. After Ctrl-C, `resume` continues with the flights that were not finished.

    Args:
        benchmark: benchmark to fly.
        output: folder of the results; created if it does not exist.
        flights: number of worlds of each row.
        seed: first seed.
        config: planner configuration, which the rows change.
        config_name: name of `config` in the report.
        device: Warp device.
        lidar: name of a LiDAR model for all rows; None uses that of each row.
        batch: largest number of simultaneous flights; None uses `default_batch`.
        resume: continue with the results in the folder.
        rules: when flights end. The arrival radius of a row overrides that of the rules.
        noise: noise of the state estimates; None flies with the true states.
        drone: differences from the vehicle that the planner assumes, by field of `VehicleModel`.
        sensor: differences from the named LiDAR models, by field of `LidarModel`.
        progress: called as flights finish.

    Raises:
        UserError: the folder holds other results, an option is out of range, or a file cannot be written.
        BenchmarkInterrupted: Ctrl-C was pressed during the flights; the results so far are written.
    """
    if flights < 1 or (batch is not None and batch < 1):
        raise UserError("The number of flights and the batch size must be at least 1.")
    size = batch or default_batch(device)
    base, rules, first_seed = config or PlannerConfig(), rules or FlightRules(), seed + benchmark.first_seed
    header = {
        "benchmark": benchmark.name,
        "date": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
        "versions": versions(),
        "hardware": hardware(device),
        "seed": seed,
        "flights": flights,
        "device": device,
        "lidar": lidar,
        "batch": size,
        "simulation": {
            "lidar": dict(sensor or {}),
            "drone": dict(drone or {}),
            "noise": None if noise is None else dataclasses.asdict(noise),
            "rules": dataclasses.asdict(rules),
        },
        "config_name": config_name,
        "config": base.to_dict(),
        "rows": [dataclasses.asdict(row) for row in benchmark.rows],
    }
    header = json.loads(json.dumps(header))
    planned = list(
        _plan_flights(benchmark, base, flights=flights, seed=first_seed, lidar=lidar, rules=rules, drone=drone or {})
    )  # before a folder is created, because a row may not fit the configuration
    names = dict.fromkeys(lidar or row.lidar for row in benchmark.rows)
    models = {name: dataclasses.replace(lidar_model(name), **(sensor or {})) for name in names}
    folder = Path(output)
    header, done = open_folder(folder, header, resume=resume)
    run = Run(benchmark, header, done)
    finished = {(flight["row"], flight["index"]) for flight in done}
    pending = [flight for flight in planned if (flight.row.label, flight.index) not in finished]

    @cache  # rows share worlds, and a device keeps equal objects once
    def load_world(name: str, count: int | None, seed: int) -> tuple[World, bool]:
        world = scene(name, count=count, seed=seed)
        return world, is_passable(world, radius=rules.radius)

    number = 1 + max((flight["batch"] for flight in done), default=-1)
    report = progress or (lambda finished, total, text: None)
    try:
        for part in _split_into_batches(pending, size):
            report(len(done), run.total, f"{part[0].row.label}: building {len(part)} worlds")
            started = time.perf_counter()
            found = [load_world(flight.row.scene, flight.row.count, flight.world_seed) for flight in part]
            worlds, passable = zip(*found, strict=True)
            flight_batch = _build(part, worlds, device=device, lidar=models[lidar or part[0].row.lidar], noise=noise)
            built = time.perf_counter()
            label = " + ".join(dict.fromkeys(flight.row.label for flight in part))
            results = flight_batch.run(progress=batch_progress(report, label, before=len(done), total=run.total))
            about_batch = {
                "batch": number,
                "batch_size": len(part),
                "build_s": built - started,
                "run_s": time.perf_counter() - built,
            }
            records = [
                {
                    "row": flight.row.label,
                    "index": flight.index,
                    "world_seed": flight.world_seed,
                    **result.to_dict(),
                    "passable": has_path,
                    **about_batch,
                }
                for flight, result, has_path in zip(part, results, passable, strict=True)
                if result.reason is not None  # after Ctrl-C some flights have not ended
            ]
            flight_batch.planner.close()
            append_flights(folder, records)
            done += records
            if flight_batch.interrupted:
                raise KeyboardInterrupt
            number += 1
            report(len(done), run.total, part[-1].row.label)
    except KeyboardInterrupt:
        raise BenchmarkInterrupted(run) from None
    return run


def _plan_flights(
    benchmark: Benchmark,
    base: PlannerConfig,
    *,
    flights: int,
    seed: int,
    lidar: str | None,
    rules: FlightRules,
    drone: Mapping[str, float],
) -> Iterator[_PlannedFlight]:
    """Yield all flights in the order of flying: those of rows that can share a batch are adjacent."""
    groups: dict[tuple[Any, ...], list[tuple[Row, PlannerConfig, VehicleModel, FlightRules]]] = {}
    for row in benchmark.rows:
        try:
            config = base if row.preset is None else PlannerConfig.preset(row.preset)
            config = config.replace({**row.changes, "vehicle.speed_limit": row.speed})
            vehicle = VehicleModel.from_config(config, **drone)
        except ValueError as error:
            raise UserError(
                f"The row {row.label!r} of {benchmark.name} does not fit the configuration: {error}"
            ) from error
        radius = row.arrival_radius
        row_rules = rules if radius is None else dataclasses.replace(rules, arrival_radius=radius)
        group = (config.structure(), vehicle, lidar or row.lidar, row_rules, row.label if row.batch else "")
        groups.setdefault(group, []).append((row, config, vehicle, row_rules))
    next_seed = seed
    for group, rows in groups.items():
        for row, config, vehicle, row_rules in rows:
            for index in range(row.batch or flights):
                world_seed = seed + index % flights
                yield _PlannedFlight(row, index, next_seed, world_seed, config, vehicle, row_rules, group)
                next_seed += 1


def _split_into_batches(pending: Iterable[_PlannedFlight], size: int) -> Iterator[list[_PlannedFlight]]:
    """Yield batches of flights with equal groups and consecutive seeds."""
    for _, members in groupby(enumerate(pending), key=lambda item: (item[1].group, item[1].seed - item[0])):
        group = [flight for _, flight in members]
        limit = group[0].row.batch or size
        for first in range(0, len(group), limit):
            yield group[first : first + limit]


def _build(
    part: Sequence[_PlannedFlight],
    worlds: Sequence[World],
    *,
    device: str,
    lidar: LidarModel,
    noise: StateNoise | None,
) -> FlightBatch:
    try:
        return FlightBatch(
            worlds,
            config=[flight.config for flight in part],
            device=device,
            seed=part[0].seed,
            lidar=lidar,
            vehicle=part[0].vehicle,
            rules=part[0].rules,
            noise=noise,
            config_names=[flight.row.label for flight in part],
        )
    except ValueError as error:
        raise UserError(f"Cannot fly {part[0].row.label!r}: {error}") from error
