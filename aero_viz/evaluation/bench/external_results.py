"""Flights of other planners in the worlds of a benchmark, for its tables and plots."""

from __future__ import annotations

import csv
import io
import logging
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from aero_planner.user_file import read_user_text
from aero_viz.errors import UserError
from aero_viz.evaluation.bench.suites import Benchmark
from aero_viz.evaluation.score import load_trajectory, score
from aero_viz.flight import FlightResult
from aero_viz.input_limits import TEXT_MAX
from aero_viz.scenes import World

_logger = logging.getLogger(__name__)
_COLUMNS = tuple(field.name for field in fields(FlightResult))
_TEXTS = ("arrived", "reason", "scene", "config", "seed", "explanation")
_NUMBERS = tuple(name for name in _COLUMNS if name not in _TEXTS)
_FORMATS = "give NAME=TABLE.csv with a table of scored flights, or NAME=FLIGHT@WORLD.json with a flight to score"
_APPEND = "give --table a new file, or a table of scored flights"


@dataclass(frozen=True)
class ExternalResults:
    """Flights of one planner in the worlds of one kind, or of one row of the benchmark."""

    planner: str
    label: str
    """Label of the row, or for flights that belong to none, the name of the worlds without the seed: forest-100."""
    flights: tuple[Mapping[str, Any], ...]
    """Records with the fields of `FlightResult`."""


def append_to_table(result: FlightResult, path: str | Path) -> None:
    """Append a flight to a CSV table. A new or empty file gets a header.

    Raises:
        UserError: the file cannot be written or is another kind of table.
    """
    path = Path(path)
    try:
        is_new = not path.exists() or path.stat().st_size == 0
        columns = list(_COLUMNS) if is_new else _read_csv(path, _APPEND)[0]
        _check_columns(path, columns, _APPEND)
        with path.open("a", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, columns, extrasaction="ignore")
            if is_new:
                writer.writeheader()
            writer.writerow(result.to_dict())
    except OSError as error:
        raise UserError(f"Cannot write the table {path}: {error.strerror or error}.") from error


def load_external_results(
    specs: Sequence[str], benchmark: Benchmark, *, seeds: Container[int] | None = None
) -> list[ExternalResults]:
    """Return the flights that the specifications name, grouped by planner and by row or kind of world.

    Args:
        specs: each "NAME=TABLE.csv" for a table of `append_to_table` or the flights.csv of a benchmark, or
            "NAME=FLIGHT@WORLD.json" for a trajectory to score.
        benchmark: flights in worlds that none of its rows has are refused.
        seeds: seeds of the worlds that the benchmark flies; flights in others are left out with a message. None keeps
            all.

    Raises:
        UserError: a specification, file or world does not fit. The text says what to give instead.
    """
    grouped: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for spec in specs:
        name, separator, file = spec.partition("=")
        if not (separator and name and file):
            raise UserError(f"{spec!r} does not name a planner and a file; {_FORMATS}.")
        trajectory, at, world = file.rpartition("@")
        if at:
            result = score(load_trajectory(trajectory), World.load(world), planner=name)
            flights: list[Mapping[str, Any]] = [result.to_dict()]
        else:
            flights = _load_table(Path(file))
        others = 0
        for flight in flights:
            kind = _find_world_kind(flight["scene"], benchmark, file)
            seed = flight["scene"].removeprefix(kind).rpartition("-")[2]
            if seeds is not None and seed.isdecimal() and int(seed) not in seeds:
                others += 1
                continue
            is_of_row = any((row.label, row.world_kind) == (flight.get("row"), kind) for row in benchmark.rows)
            grouped.setdefault((name, flight["row"] if is_of_row else kind), []).append(flight)
        if others == len(flights):
            raise UserError(f"{file} has no flight in the worlds of this run; fly the same --seed and --flights.")
        if others:
            _logger.warning("left out: %d flights of %s in worlds that this run does not have", others, file)
    return [ExternalResults(planner, label, tuple(flights)) for (planner, label), flights in grouped.items()]


def _find_world_kind(world: str, benchmark: Benchmark, file: str) -> str:
    kinds = {row.world_kind: None for row in benchmark.rows}
    found = next((kind for kind in kinds if world == kind or world.startswith(f"{kind}-")), None)
    if found is None:
        raise UserError(
            f"{file} has a flight in the world {world!r}, which is not one of the benchmark {benchmark.name}; "
            f"its worlds are named {', '.join(f'{kind}-<seed>' for kind in kinds)}."
        )
    return found


def _load_table(path: Path) -> list[Mapping[str, Any]]:
    columns, rows = _read_csv(path, _FORMATS)
    _check_columns(path, columns, _FORMATS)
    flights = []
    for number, row in rows:
        try:
            flight: dict[str, Any] = {name: row[name] for name in ("scene", "config")} | {"row": row.get("row")}
            flight |= {name: float(row[name]) if row[name] else None for name in _NUMBERS}
            flight |= {"arrived": {"True": True, "False": False}[row["arrived"]], "reason": row["reason"] or None}
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(f"{path}, line {number}: {error} is not a value of its column.") from error
        flights.append(flight)
    if not flights:
        raise UserError(f"{path} holds no flights below its header.")
    return flights


def _check_columns(path: Path, columns: Sequence[str], advice: str) -> None:
    missing = [name for name in _COLUMNS if name not in columns and name != "explanation"]
    if missing:
        problem = "is a trajectory" if {"t", "x"} <= set(columns) else f"lacks the column {missing[0]!r}"
        raise UserError(f"{path} {problem}; {advice}.")


def _read_csv(path: Path, advice: str) -> tuple[list[str], list[tuple[int, dict[str, Any]]]]:
    """Return the names of the columns and the rows with their line numbers."""
    try:
        reader = csv.DictReader(io.StringIO(read_user_text(path, limit=TEXT_MAX), newline=""))
        return list(reader.fieldnames or ()), [(reader.line_num, row) for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not CSV text"
        raise UserError(f"Cannot read {path}: {reason or error}; {advice}.") from error
