"""The files in which the flights of a benchmark are kept while it runs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from aero_planner.user_file import parse_json, read_user_text
from aero_viz.errors import UserError
from aero_viz.input_limits import TEXT_MAX

_HEADER, _FLIGHTS = "run.json", "flights.jsonl"
REPORT_FILES = (_HEADER, "summary.json", "success.png", "speed.png", "throughput.png")
"""Files of a folder of results that have the ending of a world: the header, the summary and the plots."""
_FIXED_KEYS = (
    "benchmark", "versions", "seed", "flights", "device", "lidar", "simulation", "config_name", "planner",
    "config", "rows",
)  # fmt: skip
"""Keys of the header that must be equal for a run to be resumed."""

Header = dict[str, Any]
Flights = list[dict[str, Any]]


def open_folder(folder: Path, header: Header, *, resume: bool) -> tuple[Header, Flights]:
    """Create a folder of results, or continue with the results in it.

    Args:
        folder: created if it does not exist.
        header: header of the run.
        resume: continue with the results in the folder, if there are any.

    Returns:
        The header in the folder and the finished flights.

    Raises:
        UserError: the folder holds results and `resume` is False, the results are those of another run, or the folder
            cannot be written.
    """
    if folder.is_file():
        raise UserError(f"{folder} is a file; give --output the name of a folder.")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        previous, flights = read_folder(folder)
        if previous is None:
            (folder / _FLIGHTS).unlink(missing_ok=True)
            (folder / _HEADER).write_text(json.dumps(header, indent=1) + "\n", encoding="utf-8")
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
        text = "".join(json.dumps(flight) + "\n" for flight in flights)
        (folder / _FLIGHTS).write_text(text, encoding="utf-8")
        return previous, flights
    except OSError as error:
        raise UserError(
            f"Cannot write the results to {folder}: {error.strerror or error}. Choose another --output."
        ) from error


def holds_results(folder: Path) -> bool:
    """Return True if a folder holds the flights of a benchmark."""
    return (folder / _HEADER).is_file() and (folder / _FLIGHTS).is_file()


def read_folder(folder: Path) -> tuple[Header | None, Flights]:
    """Return the header, None if the folder holds no results, and the finished flights.

    Raises:
        UserError: the files cannot be read.
    """
    try:
        header = parse_json(read_user_text(folder / _HEADER, limit=TEXT_MAX))
        lines = (
            read_user_text(folder / _FLIGHTS, limit=16 * TEXT_MAX).splitlines() if (folder / _FLIGHTS).exists() else []
        )
    except FileNotFoundError:
        return None, []
    except (OSError, ValueError) as error:
        raise UserError(f"{folder / _HEADER} cannot be read ({error}); choose another folder.") from error
    flights = []
    for line in lines:
        try:
            flights.append(parse_json(line))
        except ValueError:  # a crash interrupted the writing of this line
            break
    return header, flights


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
