"""The files in which the flights of a benchmark are kept while it runs."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from aero_planner.output_files import open_alone, whole_file
from aero_planner.plain_text import has_own_words
from aero_planner.user_file import parse_json, read_user_text
from aero_viz.errors import UserError
from aero_viz.input_limits import TEXT_MAX
from aero_viz.statistics import METRICS

_HEADER, _FLIGHTS, _LOCK = "run.json", "flights.jsonl", ".lock"
REPORT_FILES = (_HEADER, "summary.json", "success.png", "speed.png", "throughput.png")
"""Files of a folder of results that have the ending of a world: the header, the summary and the plots."""
_FIXED_KEYS = (
    "benchmark", "versions", "seed", "flights", "device", "lidar", "simulation", "config_name", "planner",
    "config", "rows",
)  # fmt: skip
"""Keys of the header that must be equal for a run to be resumed."""

_NUMBER, _NONE = (int, float), type(None)
_HEADER_KINDS = {
    "benchmark": str, "seed": int, "lidar": (str, _NONE), "simulation": dict, "versions": dict, "device": str,
    "config": dict,
}  # fmt: skip
"""Types of the values that a header has."""
_ROW_KINDS = {"label": str}
_FLIGHT_KINDS = {"row": str, "index": int, "world_seed": int, "arrived": bool, "flight_time_s": (*_NUMBER, _NONE)}
"""Types of the values that a flight has."""
_BATCH_KINDS = {
    "batch": int, "batch_size": int, "run_s": _NUMBER, "reason": (str, _NONE), "plan_ms_median": (*_NUMBER, _NONE),
    **dict.fromkeys(METRICS, (*_NUMBER, _NONE)),
}  # fmt: skip
"""Types of the values that a flight of a batch has, besides."""

Header = dict[str, Any]
Flights = list[dict[str, Any]]


@contextlib.contextmanager
def open_folder(folder: Path, header: Header, *, resume: bool) -> Iterator[tuple[Header, Flights]]:
    """Create a folder of results, or continue with the results in it. No other program writes to it meanwhile.

    Args:
        folder: created if it does not exist.
        header: header of the run.
        resume: continue with the results in the folder, if there are any.

    Yields:
        The header in the folder and the finished flights.

    Raises:
        UserError: the folder holds results and `resume` is False, the results are those of another run, or the folder
            cannot be written, also because another program does.
    """
    if folder.is_file():
        raise UserError(f"{folder} is a file; give --output the name of a folder.")
    with contextlib.ExitStack() as stack:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            stack.enter_context(open_alone(folder / _LOCK))
            stack.callback((folder / _LOCK).unlink, missing_ok=True)
            found = _continue(folder, header, resume=resume)
        except OSError as error:
            raise UserError(
                f"Cannot write the results to {folder}: {error.strerror or error}. Choose another --output."
            ) from error
        yield found


def _continue(folder: Path, header: Header, *, resume: bool) -> tuple[Header, Flights]:
    """Return the header and the finished flights of a folder; raises as `open_folder`, and OSError."""
    previous, flights = read_folder(folder)
    if previous is None:
        (folder / _FLIGHTS).unlink(missing_ok=True)
        with whole_file(folder / _HEADER) as file:
            file.write_text(json.dumps(header, indent=1) + "\n", encoding="utf-8")
        return header, []
    if not resume:
        raise UserError(f"{folder} holds results already; add --resume to continue, or choose another --output.")
    for key in _FIXED_KEYS:
        if previous.get(key) != header.get(key):
            raise UserError(
                f"The run in {folder} cannot be resumed: {_difference(key, previous.get(key), header.get(key))}; "
                "choose another --output, or the same options and versions."
            )
    # Drops the incomplete last line that a crash may have left.
    with whole_file(folder / _FLIGHTS) as file:
        file.write_text("".join(json.dumps(flight) + "\n" for flight in flights), encoding="utf-8")
    return previous, flights


def holds_results(folder: Path) -> bool:
    """Return True if a folder holds the flights of a benchmark."""
    return (folder / _HEADER).is_file() and (folder / _FLIGHTS).is_file()


def read_folder(folder: Path) -> tuple[Header | None, Flights]:
    """Return the header, None if the folder holds no results, and the finished flights.

    Raises:
        UserError: the files cannot be read.
    """
    file = folder / _HEADER
    try:
        header = parse_json(read_user_text(file, limit=TEXT_MAX))
        _check(header, _HEADER_KINDS)
        for row in header.get("rows", ()):
            _check(row, _ROW_KINDS)
        file = folder / _FLIGHTS
        lines = read_user_text(file, limit=16 * TEXT_MAX).splitlines() if file.exists() else []
        flights = []
        for number, line in enumerate(lines, 1):
            try:
                flight = parse_json(line)
            except ValueError:
                if number == len(lines):  # a crash interrupted the writing of this line
                    break
                raise
            _check(flight, _FLIGHT_KINDS)
            _check(flight, _BATCH_KINDS if "batch" in flight else {})
            flights.append(flight)
    except FileNotFoundError:
        return None, []
    except (OSError, TypeError, ValueError) as error:
        reason = getattr(error, "strerror", None) or (error if has_own_words(error) else "it is damaged")
        raise UserError(f"{file} cannot be read: {reason}; choose another folder.") from error
    return header, flights


def _check(record: Any, kinds: Mapping[str, Any]) -> None:
    """Raise ValueError unless a record has values of these types by these keys."""
    if not isinstance(record, dict):
        raise ValueError("it is damaged: it holds something else than records")
    for key, kind in kinds.items():
        if not isinstance(record.get(key), kind) or (isinstance(record.get(key), bool) and kind is not bool):
            raise ValueError(f"it is damaged: a record has no valid value of {key}")


def append_flights(folder: Path, flights: Flights) -> None:
    """Append finished flights to those in the folder.

    Raises:
        UserError: the file cannot be written.
    """
    try:
        with (folder / _FLIGHTS).open("a", encoding="utf-8") as file:
            file.write("".join(json.dumps(flight) + "\n" for flight in flights))
    except OSError as error:
        raise UserError(f"Cannot write {folder / _FLIGHTS}: {error.strerror or error}.") from error


def _difference(key: str, previous: Any, current: Any) -> str:
    """Return a description of the first difference between two values of the header."""
    if isinstance(previous, dict) and isinstance(current, dict):
        name = next(name for name in {**previous, **current} if previous.get(name) != current.get(name))
        return _difference(f"{key}.{name}", previous.get(name), current.get(name))
    if isinstance(previous, list) or isinstance(current, list):
        return f"{key} differ"
    return f"{key} was {previous!r} and is {current!r}"
