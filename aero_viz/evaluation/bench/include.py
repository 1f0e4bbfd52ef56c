"""Flights of other planners, scored in the same worlds, for the tables and plots of a benchmark."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from aero_viz.errors import UserError
from aero_viz.evaluation.bench.catalog import Benchmark
from aero_viz.evaluation.score import load_trajectory, score
from aero_viz.flight import FlightResult
from aero_viz.scenes import World

__all__ = ["Included", "append_to_table", "load_included"]

_COLUMNS = tuple(f.name for f in fields(FlightResult))
_TEXTS = ("arrived", "reason", "scene", "config", "seed", "explanation")
_NUMBERS = tuple(name for name in _COLUMNS if name not in _TEXTS)
_FORM = "give NAME=TABLE.csv with the table that `aero-viz score --table` writes, or NAME=FLIGHT@WORLD.json"


@dataclass(frozen=True)
class Included:
    """Flights of one planner in the worlds of one kind."""

    planner: str
    kind: str
    """Name of the worlds without the seed, such as forest-100."""
    flights: tuple[Mapping[str, Any], ...]


def append_to_table(result: FlightResult, path: str | Path) -> None:
    """Append a flight to a CSV table, with a header where the file is new or empty.

    Raises:
        UserError: the file cannot be written, or is another kind of table.
    """
    path = Path(path)
    try:
        new = not path.exists() or path.stat().st_size == 0
        columns = list(_COLUMNS) if new else _read(path)[0]
        _check_header(path, columns)
        with path.open("a", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, columns, extrasaction="ignore")
            if new:
                writer.writeheader()
            writer.writerow(result.to_dict())
    except OSError as error:
        raise UserError(f"Cannot write the table {path}: {error.strerror or error}.") from error


def load_included(specs: Sequence[str], benchmark: Benchmark) -> list[Included]:
    """Return the flights that the specifications name, grouped by planner and kind of world.

    Args:
        specs: each "NAME=TABLE.csv", the table of `append_to_table` or the benchmark's own flights.csv, or
            "NAME=FLIGHT@WORLD.json", a trajectory to score.
        benchmark: flights in worlds that none of its rows has are refused.

    Raises:
        UserError: a specification, file or world does not fit; says what to give instead.
    """
    grouped: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for spec in specs:
        name, separator, file = spec.partition("=")
        if not (separator and name and file):
            raise UserError(f"--include {spec!r} has no name and file; {_FORM}.")
        trajectory, at, world = file.rpartition("@")
        if at:
            result = score(load_trajectory(trajectory), World.load(world), planner=name)
            flights: list[Mapping[str, Any]] = [result.to_dict()]
        else:
            flights = _load_table(Path(file))
        for flight in flights:
            grouped.setdefault((name, _kind(flight["scene"], benchmark, file)), []).append(flight)
    return [Included(planner, kind, tuple(flights)) for (planner, kind), flights in grouped.items()]


def _kind(world: str, benchmark: Benchmark, file: str) -> str:
    kinds = {row.name_prefix: None for row in benchmark.rows}
    found = next((kind for kind in kinds if world == kind or world.startswith(f"{kind}-")), None)
    if found is None:
        raise UserError(
            f"{file} has a flight in the world {world!r}, which is not of the benchmark {benchmark.name}; "
            f"its worlds are named {', '.join(f'{kind}-<seed>' for kind in kinds)}."
        )
    return found


def _load_table(path: Path) -> list[Mapping[str, Any]]:
    header, rows = _read(path)
    _check_header(path, header)
    flights = []
    for number, row in enumerate(rows, start=2):
        try:
            flight: dict[str, Any] = {name: row[name] for name in ("scene", "config")}
            flight |= {name: float(row[name]) if row[name] else None for name in _NUMBERS}
            flight |= {"arrived": {"True": True, "False": False}[row["arrived"]], "reason": row["reason"] or None}
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(f"{path}, line {number}: {error} is no value of its column.") from error
        flights.append(flight)
    if not flights:
        raise UserError(f"{path} holds no flights below its first line.")
    return flights


def _check_header(path: Path, header: Sequence[str]) -> None:
    missing = [name for name in _COLUMNS if name not in header and name != "explanation"]
    if missing:
        what = "is a trajectory" if {"t", "x"} <= set(header) else f"lacks the column {missing[0]!r}"
        raise UserError(f"{path} {what}; {_FORM}.")


def _read(path: Path) -> tuple[list[str], list[dict[str, Any]]]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            return list(reader.fieldnames or ()), list(reader)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is no CSV text"
        raise UserError(f"Cannot read {path}: {reason or error}; {_FORM}.") from error
