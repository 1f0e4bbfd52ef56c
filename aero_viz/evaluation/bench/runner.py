"""Flies a benchmark in batches, and keeps every batch as soon as it is over."""

from __future__ import annotations

import dataclasses
import datetime
import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import warp as wp

from aero_planner import PlannerConfig
from aero_planner.warp_init import quieten
from aero_viz.errors import UserError
from aero_viz.evaluation.bench.catalog import Benchmark, Row
from aero_viz.evaluation.bench.machine import hardware, versions
from aero_viz.flight import FlightBatch, FlightRules, StateNoise, VehicleModel
from aero_viz.scenes import World, scene
from aero_viz.sensors import LidarModel, lidar_model

__all__ = ["Progress", "Run", "default_batch", "load_run", "run_benchmark"]

_HEADER, _FLIGHTS = "run.json", "flights.jsonl"
_SAME = ("benchmark", "versions", "seed", "flights", "device", "lidar", "simulation", "config_name", "config", "rows")

Progress = Callable[[int, int, str], None]
"""Called with the number of flights that are over, of all, and what is going on."""


@dataclass(frozen=True)
class Run:
    """A benchmark's flights so far."""

    benchmark: Benchmark
    header: dict[str, Any]
    """What the results depend on: seed, configuration, versions, hardware, date."""
    flights: list[dict[str, Any]]
    """`FlightResult` of each flight with its row, index, world_seed, passable, and its batch, batch_size, build_s and
    run_s."""
    total: int
    """Flights of the whole benchmark."""

    @property
    def is_complete(self) -> bool:
        """Whether all flights are there."""
        return len(self.flights) == self.total


@dataclass(frozen=True)
class _Flight:
    """One flight to be done."""

    row: Row
    index: int
    seed: int
    """Of LiDAR and planner: consecutive in the order of flying, as a batch needs it, whatever the batches are."""
    world_seed: int
    config: PlannerConfig
    vehicle: VehicleModel
    rules: FlightRules
    group: tuple[Any, ...]
    """Flights of one batch have equal groups."""


def default_batch(device: str) -> int:
    """Return how many flights to fly at once: 256 on a GPU; one on the CPU, which batches do not make faster.

    Raises:
        UserError: there is no such device.
    """
    quieten()
    try:
        return 256 if wp.get_device(device).is_cuda else 1
    except ValueError as error:
        raise UserError(f"The device {device!r} is not available: {error}; see aero-viz doctor.") from error


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
    """Fly what of a benchmark is not in the folder `output` yet, and return all of it.

    World i of every row has the seed `seed` + i; flights, in the order of flying, have the seeds `seed`, `seed` + 1, ..
    for LiDAR and planner, so that batches of any size give the same results. Each batch is written when it is over, or
    interrupted: after a Ctrl-C, `resume` goes on with the flights that were not over.

    Args:
        benchmark: what to fly.
        output: folder of the results; made when missing.
        flights: worlds of each row.
        seed: first seed.
        config: of the planner; rows change it.
        config_name: of `config`, for the report.
        device: Warp device.
        lidar: name of the LiDAR in the place of each row's own.
        batch: flights at once at most; None is `default_batch`.
        resume: go on with what is in the folder.
        rules: when flights end; the arrival radius of a row that has one replaces theirs.
        noise: of the state estimates; None for the true states.
        drone: what differs from the vehicle that the planner assumes, by field of `VehicleModel`.
        sensor: what differs from the named LiDARs, by field of `LidarModel`.
        progress: told how it goes.

    Raises:
        UserError: the folder holds other results, an option is out of range, or a file cannot be written.
    """
    if flights < 1 or (batch is not None and batch < 1):
        raise UserError("The numbers of flights and of flights in a batch must be at least 1.")
    size = batch or default_batch(device)
    base, rules, seed_0 = config or PlannerConfig(), rules or FlightRules(), seed + benchmark.first_seed
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
    planned = list(_plan(benchmark, base, flights=flights, seed=seed_0, lidar=lidar, rules=rules, drone=drone or {}))
    names = dict.fromkeys(lidar or row.lidar for row in benchmark.rows)
    models = {name: dataclasses.replace(lidar_model(name), **(sensor or {})) for name in names}
    folder = Path(output)
    header, done = _open(folder, header, resume=resume)
    run = Run(benchmark, header, done, len(planned))
    finished = {(flight["row"], flight["index"]) for flight in done}
    pending = [flight for flight in planned if (flight.row.label, flight.index) not in finished]
    shelf = _Shelf(rules.radius)
    number = 1 + max((flight["batch"] for flight in done), default=-1)
    report = progress or (lambda over, total, text: None)
    for part in _batches(pending, size):
        report(len(done), run.total, f"{part[0].row.label}: building {len(part)} worlds")
        started = time.perf_counter()
        worlds, found = zip(*(shelf.take(flight.row, flight.world_seed) for flight in part), strict=True)
        model = models[lidar or part[0].row.lidar]
        flown = _build(part, worlds, device=device, lidar=model, noise=noise)
        built = time.perf_counter()
        label = " + ".join(dict.fromkeys(flight.row.label for flight in part))
        results = flown.run(progress=partial(_tell, report, label, len(done), run.total))
        seconds = {"build_s": built - started, "run_s": time.perf_counter() - built}
        records = [
            {
                "row": flight.row.label,
                "index": flight.index,
                "world_seed": flight.world_seed,
                **result.to_dict(),
                "passable": passable,
                "batch": number,
                "batch_size": len(part),
                **seconds,
            }
            for flight, result, passable in zip(part, results, found, strict=True)
            if result.reason is not None  # after a Ctrl-C, those that are over stay
        ]
        flown.planner.close()
        _append(folder, records)
        if flown.interrupted:
            raise KeyboardInterrupt
        done += records
        number += 1
        report(len(done), run.total, part[-1].row.label)
    return run


def load_run(folder: str | Path, benchmark: Benchmark) -> Run:
    """Return the results in a folder, whole or not.

    Raises:
        UserError: there are none.
    """
    header, flights = _read(Path(folder))
    if header is None:
        raise UserError(f"{folder} holds no results of a benchmark.")
    return Run(benchmark, header, flights, sum(row.batch or header["flights"] for row in benchmark.rows))


def _plan(
    benchmark: Benchmark,
    base: PlannerConfig,
    *,
    flights: int,
    seed: int,
    lidar: str | None,
    rules: FlightRules,
    drone: Mapping[str, float],
) -> Iterator[_Flight]:
    """Yield all flights in the order of flying: rows that can share a batch follow each other."""
    groups: dict[tuple[Any, ...], list[tuple[Row, PlannerConfig, VehicleModel, FlightRules]]] = {}
    for row in benchmark.rows:
        try:
            config = base if row.preset is None else PlannerConfig.preset(row.preset)
            config = config.replace({**row.changes, "vehicle.speed_limit": row.speed})
            vehicle = VehicleModel.from_config(config, **drone)
        except ValueError as error:
            raise UserError(f"The row {row.label!r} of {benchmark.name} does not fit the configuration: {error}") from (
                error
            )
        radius = row.arrival_radius
        own_rules = rules if radius is None else dataclasses.replace(rules, arrival_radius=radius)
        group = (config.structure(), vehicle, lidar or row.lidar, own_rules, row.label if row.batch else "")
        groups.setdefault(group, []).append((row, config, vehicle, own_rules))
    next_seed = seed
    for group, rows in groups.items():
        for row, config, vehicle, own_rules in rows:
            for index in range(row.batch or flights):
                world_seed = seed + index % flights
                yield _Flight(row, index, next_seed, world_seed, config, vehicle, own_rules, group)
                next_seed += 1


def _batches(pending: Iterable[_Flight], size: int) -> Iterator[list[_Flight]]:
    """Split into batches of equal groups and consecutive seeds."""
    for _, members in groupby(enumerate(pending), key=lambda item: (item[1].group, item[1].seed - item[0])):
        group = [flight for _, flight in members]
        limit = group[0].row.batch or size
        for first in range(0, len(group), limit):
            yield group[first : first + limit]


class _Shelf:
    """Worlds and whether they can be passed, made once: rows share worlds, and the device keeps equal objects once."""

    def __init__(self, radius: float) -> None:
        self._radius = radius
        self._made: dict[tuple[str, int | None, int], tuple[World, bool]] = {}

    def take(self, row: Row, seed: int) -> tuple[World, bool]:
        from aero_viz.scenes.passable import is_passable

        key = (row.scene, row.count, seed)
        if key not in self._made:
            world = scene(row.scene, count=row.count, seed=seed)
            self._made[key] = (world, is_passable(world, radius=self._radius))
        return self._made[key]


def _build(
    part: Sequence[_Flight],
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


def _tell(report: Progress, label: str, over: int, total: int, finished: int, batch: int, seconds: float) -> None:
    """Pass on how a batch goes, as part of the whole."""
    report(over + finished, total, f"{label}: {seconds:.1f} s, {finished} of {batch} over")


def _open(folder: Path, header: dict[str, Any], *, resume: bool) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the header that holds, `header` or that of the run to go on with, and the flights that are done."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        before, flights = _read(folder)
        if before is None:
            (folder / _FLIGHTS).unlink(missing_ok=True)
            (folder / _HEADER).write_text(json.dumps(header, indent=1) + "\n", encoding="utf-8")
            return header, []
        if not resume:
            raise UserError(f"{folder} holds results already; add --resume to go on, or choose another --output.")
        for key in _SAME:
            if before.get(key) != header[key]:
                raise UserError(
                    f"The run in {folder} cannot go on: {_difference(key, before.get(key), header[key])}; "
                    "choose another --output, or the same options and versions."
                )
        # Without what a crash may have left of a line.
        text = "".join(json.dumps(flight) + "\n" for flight in flights)
        (folder / _FLIGHTS).write_text(text, encoding="utf-8")
        return before, flights
    except OSError as error:
        raise UserError(f"Cannot write the results to {folder}: {error.strerror or error}.") from error


def _difference(key: str, before: Any, now: Any) -> str:
    """Say what differs, down to the first parameter."""
    if isinstance(before, dict) and isinstance(now, dict):
        name = next(name for name in {**before, **now} if before.get(name) != now.get(name))
        return _difference(f"{key}.{name}", before.get(name), now.get(name))
    if isinstance(before, list) or isinstance(now, list):
        return f"{key} are others"
    return f"{key} was {before!r} and is {now!r}"


def _read(folder: Path) -> tuple[dict[str, Any] | None, list[dict[str, Any]]]:
    try:
        header = json.loads((folder / _HEADER).read_text(encoding="utf-8"))
        lines = (folder / _FLIGHTS).read_text(encoding="utf-8").splitlines() if (folder / _FLIGHTS).exists() else []
    except FileNotFoundError:
        return None, []
    except (OSError, ValueError) as error:
        raise UserError(f"{folder / _HEADER} cannot be read ({error}); choose another --output.") from error
    flights = []
    for line in lines:
        try:
            flights.append(json.loads(line))
        except ValueError:  # torn by a crash
            break
    return header, flights


def _append(folder: Path, records: list[dict[str, Any]]) -> None:
    try:
        with (folder / _FLIGHTS).open("a", encoding="utf-8") as file:
            file.write("".join(json.dumps(record) + "\n" for record in records))
    except OSError as error:
        raise UserError(f"Cannot write {folder / _FLIGHTS}: {error.strerror or error}.") from error
