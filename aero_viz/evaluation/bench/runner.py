"""Flying a benchmark in batches. The results of a batch are written as soon as it is finished."""

from __future__ import annotations

import dataclasses
import datetime
import json
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from typing import Any

from aero_planner import PlannerConfig
from aero_planner.config import DroneConfig
from aero_viz.errors import UserError
from aero_viz.evaluation.batching import FlightOptions, Progress, batch_status, check_count, default_batch
from aero_viz.evaluation.bench.causes import cause_of
from aero_viz.evaluation.bench.result_folder import append_flights, open_folder
from aero_viz.evaluation.bench.sudden_object import SuddenObjects, check_arrival
from aero_viz.evaluation.bench.suites import Benchmark, Row
from aero_viz.evaluation.difficulty import describe_world
from aero_viz.evaluation.executor import Executor, LocalExecutor
from aero_viz.evaluation.machine import hardware, versions
from aero_viz.flight import FlightBatch, FlightInterrupted, FlightRules, StateNoise, VehicleModel
from aero_viz.flight.batch import BatchProgress
from aero_viz.flight.explanation import refuse_impossible
from aero_viz.flight.serial import SerialFlights
from aero_viz.planners.registry import is_aero_mppi, name_of, planner_entry
from aero_viz.scenes import World, scene
from aero_viz.seed_range import check_seed
from aero_viz.sensors import lidar_model

STAGE_FIELD = "stage_ms."
"""Beginning of the names of the fields with the times of the stages of a tick [ms]."""
_TIMED_TICK = 100
"""Ticks after which the stages are timed: the drones are then among the obstacles."""
_TIMED_TICKS = 25


@dataclass(frozen=True)
class Run:
    """The flights of a benchmark so far."""

    benchmark: Benchmark
    header: dict[str, Any]
    """Everything that the results depend on (seed, configuration, versions), the hardware and the date."""
    flights: list[dict[str, Any]]
    """One record per flight: the fields of `FlightResult`, row, index, world_seed, passable, and of its batch batch,
    batch_size, build_s and run_s; in a benchmark of the throughput also the times of the stages, see STAGE_FIELD; where
    an object appears also object_speed, the speed of the drone then [m/s], or None if it did not appear."""

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
    """Seed of LiDAR and planner."""
    world_seed: int
    config: DroneConfig
    vehicle: VehicleModel
    rules: FlightRules
    group: tuple[Any, ...]
    """Flights can share a batch if their groups are equal."""
    world: World | None = None
    """World from a file; None for a scene."""


def run_benchmark(
    benchmark: Benchmark,
    output: str | Path,
    *,
    flights: int = 50,
    seed: int = 0,
    config: DroneConfig | None = None,
    config_name: str = "default",
    device: str = "cpu",
    lidar: str | None = None,
    batch: int | None = None,
    resume: bool = False,
    rules: FlightRules | None = None,
    noise: StateNoise | None = None,
    drone: Mapping[str, float] | None = None,
    sensor: Mapping[str, Any] | None = None,
    examine: bool = True,
    executor: Executor | None = None,
    progress: Progress | None = None,
    causes: bool = True,
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
        examine: search a path through every world and measure its difficulty, which takes about 1 s of CPU time. Worlds
            in which an object appears are not examined.
        executor: flies the batches; None flies one after the other in this process.
        progress: called as flights finish.
        causes: fly each failure again, alone, and explain it, except where an object appears.

    Raises:
        UserError: the folder holds other results, an option is out of range, or a file cannot be written.
        BenchmarkInterrupted: Ctrl-C was pressed during the flights; the results so far are written.
    """
    if flights < 1 or (batch is not None and batch < 1):
        raise UserError("--flights and --batch must be at least 1.")
    check_count("--flights", flights)
    check_seed(seed)
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
        **planner_entry(base),
        "config": base.to_dict(),
        "rows": [dataclasses.asdict(row) for row in benchmark.rows],
    }
    header = json.loads(json.dumps(header))
    planned = list(
        _plan_flights(benchmark, base, flights=flights, seed=first_seed, lidar=lidar, rules=rules, drone=drone or {})
    )  # before a folder is created, because a row may not fit the configuration
    _refuse_impossible_worlds(planned)
    names = dict.fromkeys(lidar or row.lidar for row in benchmark.rows)
    models = {name: dataclasses.replace(lidar_model(name), **(sensor or {})) for name in names}
    folder = Path(output)
    with open_folder(folder, header, resume=resume) as (header, done):
        run = Run(benchmark, header, done)
        finished = {(flight["row"], flight["index"]) for flight in done}
        pending = [flight for flight in planned if (flight.row.label, flight.index) not in finished]
        executor = executor or LocalExecutor()
        shards = []
        for part in _split_into_batches(pending, size):
            model = models[lidar or part[0].row.lidar]
            options = FlightOptions(device, model, part[0].vehicle, part[0].rules, noise)
            shards.append(_Shard(tuple(part), options, rules.radius, examine, executor.threads, causes))
        _fly_shards(run, folder, shards, executor, progress or (lambda finished, total, text: None))
    return run


@dataclass(frozen=True)
class _Shard:
    """The flights of one batch and everything that they depend on."""

    flights: tuple[_PlannedFlight, ...]
    options: FlightOptions
    radius: float
    """Radius of the drone, for which a path is searched [m]."""
    examine: bool
    threads: int | None
    causes: bool

    @property
    def label(self) -> str:
        """Labels of the rows that the flights belong to."""
        return " + ".join(dict.fromkeys(flight.row.label for flight in self.flights))


def _fly_shards(run: Run, folder: Path, shards: Sequence[_Shard], executor: Executor, report: Progress) -> None:
    """Fly shards, and write the results of each as soon as it has ended.

    Raises:
        BenchmarkInterrupted: Ctrl-C was pressed.
    """
    batch = 1 + max((flight["batch"] for flight in run.flights), default=-1)
    ended = 0

    def describe() -> None:
        if ended < len(shards):
            shard = shards[ended]
            report(len(run.flights), run.total, f"{shard.label}: building {len(shard.flights)} worlds")

    def follow(finished: int, flights: int, seconds: float) -> None:
        report(len(run.flights) + finished, run.total, batch_status(shards[ended].label, finished, flights, seconds))

    try:
        describe()
        for index, (records, interrupted) in executor.map(_fly_shard, shards, progress=follow):
            records = [{**record, "batch": batch + index} for record in records]
            append_flights(folder, records)
            run.flights.extend(records)
            ended += 1
            if interrupted:
                raise KeyboardInterrupt
            report(len(run.flights), run.total, shards[index].label)
            describe()
    except KeyboardInterrupt:
        raise BenchmarkInterrupted(run) from None


def _fly_shard(shard: _Shard, progress: BatchProgress | None) -> tuple[list[dict[str, Any]], bool]:
    """Fly one shard; return the records of the flights that ended, and whether Ctrl-C interrupted it.

    Raises:
        UserError: the flights do not fit each other.
    """
    started = time.perf_counter()
    worlds = [
        flight.world or _generate_world(flight.row.scene, flight.row.count, flight.world_seed)
        for flight in shard.flights
    ]
    about_worlds = [
        _describe(world, shard.radius) if shard.examine and flight.row.sudden is None else {"passable": None}
        for flight, world in zip(shard.flights, worlds, strict=True)
    ]
    batch = _build(shard, worlds)
    objects = [flight.row.sudden for flight in shard.flights]
    speeds: list[float | None] = [None] * len(worlds)
    if isinstance(batch, FlightBatch):
        speeds = SuddenObjects(batch, worlds, objects, [flight.world_seed for flight in shard.flights]).speeds
    built = time.perf_counter()
    results = batch.run(progress=progress)
    about_batch: dict[str, Any] = {
        "batch_size": len(shard.flights),
        "build_s": built - started,
        "run_s": time.perf_counter() - built,
    }
    if all(flight.row.batch for flight in shard.flights) and not batch.interrupted:
        about_batch |= _time_stages(shard, worlds)
    records = [
        {
            "row": flight.row.label,
            "index": flight.index,
            "world_seed": flight.world_seed,
            **result.to_dict(),
            **about_world,
            **about_batch,
            **({"object_speed": speed} if flight.row.sudden else {}),
        }
        for flight, result, about_world, speed in zip(shard.flights, results, about_worlds, speeds, strict=True)
        if result.reason is not None  # after Ctrl-C some flights have not ended
    ]
    batch.close()
    interrupted = batch.interrupted or not _explain(shard, worlds, records)
    return records, interrupted


def _explain(shard: _Shard, worlds: Sequence[World], records: list[dict[str, Any]]) -> bool:
    """Add the causes of the failures to the records; return False if Ctrl-C interrupted that."""
    flown = {
        (flight.row.label, flight.index): (flight, world) for flight, world in zip(shard.flights, worlds, strict=True)
    }
    for record in records:
        flight, world = flown[record["row"], record["index"]]
        if record["arrived"] or flight.row.batch or flight.row.sudden or not shard.causes:
            continue
        options = {"config": flight.config, "seed": flight.seed, **vars(shard.options)}
        try:
            record |= cause_of(world, record["reason"], **options)
        except FlightInterrupted:
            return False
    return True


def _time_stages(shard: _Shard, worlds: Sequence[World]) -> dict[str, float]:
    """Return the times of the stages of a tick in the middle of the flights, as fields of a record [ms].

    The flights start again, because timing the stages of the planner would delay those whose time counts.
    """
    batch = _build(shard, worlds)
    assert isinstance(batch, FlightBatch)  # see `_plan_flights`
    for _ in range(_TIMED_TICK):
        batch.step()
    stages = batch.time_stages(_TIMED_TICKS)
    batch.planner.close()
    return {f"{STAGE_FIELD}{name}": milliseconds for name, milliseconds in stages.items()}


@lru_cache(maxsize=4096)  # rows share worlds, and a device keeps equal objects once
def _generate_world(name: str, count: int | None, seed: int) -> World:
    return scene(name, count=count, seed=seed)


@lru_cache(maxsize=4096)
def _describe(world: World, radius: float) -> dict[str, Any]:
    """Return the fields of a record that describe a world, for a drone of this radius [m]."""
    return describe_world(world, radius=radius)


def _plan_flights(
    benchmark: Benchmark,
    base: DroneConfig,
    *,
    flights: int,
    seed: int,
    lidar: str | None,
    rules: FlightRules,
    drone: Mapping[str, float],
) -> Iterator[_PlannedFlight]:
    """Yield all flights in the order of flying: those of rows that can share a batch are adjacent."""
    groups: dict[tuple[Any, ...], list[tuple[Row, DroneConfig, VehicleModel, FlightRules]]] = {}
    if not is_aero_mppi(base) and (rows := [row for row in benchmark.rows if row.batch or row.sudden]):
        raise UserError(
            f"{benchmark.name} flies batches on the device, as in the row {rows[0].label!r}, which {name_of(base)} "
            "cannot; choose another benchmark, or AERO-MPPI."
        )
    for row in benchmark.rows:
        try:
            config = base if row.preset is None else type(base).preset(row.preset)
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
                world = benchmark.worlds.get(row.label)
                if row.sudden is not None and world is not None:
                    check_arrival(row.label, row.sudden, world, row_rules)
                yield _PlannedFlight(row, index, next_seed, world_seed, config, vehicle, row_rules, group, world)
                next_seed += 1


def _refuse_impossible_worlds(planned: Sequence[_PlannedFlight]) -> None:
    """Raise a UserError if no planner can arrive in the world of a file, which would count as its failure."""
    for flight in planned:
        if flight.world is None or flight.index > 0:
            continue
        try:
            refuse_impossible(flight.world, rules=flight.rules, speed_limit=flight.config.vehicle.speed_limit)
        except UserError as error:
            raise UserError(f"Cannot fly {flight.row.label!r}: {error}") from error


def _split_into_batches(pending: Iterable[_PlannedFlight], size: int) -> Iterator[list[_PlannedFlight]]:
    """Yield batches of flights with equal groups."""
    for _, members in groupby(pending, key=lambda flight: flight.group):
        group = list(members)
        limit = group[0].row.batch or size
        for first in range(0, len(group), limit):
            yield group[first : first + limit]


def _build(shard: _Shard, worlds: Sequence[World]) -> FlightBatch | SerialFlights:
    flights = shard.flights
    configs, seeds = [flight.config for flight in flights], [flight.seed for flight in flights]
    labels = [flight.row.label for flight in flights]
    try:
        return shard.options.build(worlds, configs, seeds, threads=shard.threads, names=labels)
    except ValueError as error:
        raise UserError(f"Cannot fly {labels[0]!r}: {error}") from error
