"""Points of texts: a row per point, with or without a header that names the columns."""

from __future__ import annotations

import io
import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np
from numpy.typing import NDArray

from aero_planner.user_file import open_user_file
from aero_viz.input_limits import MAP_POINTS_MAX
from aero_viz.point_times import time_field
from aero_viz.scenes.decoder_checks import check_count, load_rows

TEXT_SUFFIXES = (".xyz", ".xyzn", ".xyzrgb", ".pts", ".asc", ".csv", ".txt")
_HEAD = 1 << 16
"""Bytes in which the header and the first rows are looked for."""
_ROWS = 20
"""Number of rows from which the columns are found."""
_COMMENTS = ("#", "//", "%", "!")
_UNITS = {
    "mm": 1e-3, "cm": 1e-2, "m": 1.0, "meter": 1.0, "meters": 1.0, "metre": 1.0, "metres": 1.0, "km": 1e3,
    "in": 0.0254, "inch": 0.0254, "inches": 0.0254, "ft": 0.3048, "foot": 0.3048, "feet": 0.3048,
}  # fmt: skip
_NAME_AND_UNIT = re.compile(rf"([^(\[]*?)[ _/]*[(\[]?\s*({'|'.join(_UNITS)})?\s*[)\]]?")
_AXIS = re.compile(
    r"(?:points?|pos|position|p|coord|points_m_xyz|points:|local)?[ ._:-]*([xyz012])(?:1|coord|_?coordinate)?"
)
"""Names of coordinates, such as x, X1, point.x, Points_m_XYZ:0."""


class TextLayout(NamedTuple):
    """How the rows of a text are read."""

    skipped: int
    """Number of lines before the first row."""
    separator: str | None
    """Character between columns; None for any white space."""
    has_decimal_commas: bool
    columns: tuple[int, int, int]
    """Numbers of the columns x, y and z."""
    names: tuple[str, ...]
    """Names of all columns, none without a header."""
    unit: float
    """[m]."""
    declared: int | None
    """Number of points that the text declares before its rows."""

    def __str__(self) -> str:
        between = {None: "spaces", ",": "commas", ";": "semicolons", "\t": "tabs"}[self.separator]
        axes = [self.names[i] if self.names else f"column {i + 1}" for i in self.columns]
        unit = "" if self.unit == 1.0 else f", in units of {self.unit:g} m"
        shown = ", ".join("".join(c if c.isprintable() else "?" for c in axis)[:40] for axis in axes)
        return f"x, y, z are {shown} of the text, between {between}{unit}"


def find_text_layout(path: Path) -> TextLayout | None:
    """Return how a text is read, None if it holds no rows of points.

    Raises:
        OSError: it cannot be read.
        ValueError: its header names no coordinates, or it is no text.
    """
    with open_user_file(path) as file:
        data = file.read(_HEAD)
    if b"\0" in data:
        return None
    text = data.decode("utf-8-sig", errors="replace")
    lines = text.splitlines()[: -1 if len(data) == _HEAD else None]
    header, declared, first = "", None, None
    for number, line in enumerate(lines):
        words = _split(line, _separator(line))
        if line.lstrip().startswith(_COMMENTS):
            header = line.lstrip().lstrip("#/%! ") or header
        elif not line.strip():
            continue
        elif len(words) == 1 and words[0].isdecimal() and declared is None:
            declared = int(words[0])
        elif _is_row(words, header):
            first = number
            break
        elif len(words) >= 3 and (number == 0 or any(map(_axis, words))):
            header = line
        else:
            return None
    if first is None:
        return None
    rows = [line for line in lines[first : first + _ROWS] if line.strip()]
    separator = _separator(rows[0])
    has_decimal_commas = separator != "," and any("," in word for word in _split(rows[0], separator))
    width = len(_split(rows[0], separator))
    names = tuple(word.strip().strip("\"'") for word in _split(header, _separator(header)))
    columns, unit = (0, 1, 2), 1.0
    if len(names) == width and not all(map(_is_number, names)):
        columns, unit = _coordinates(names)
    elif sum(map(bool, map(_axis, names))) >= 3:
        columns, unit = _coordinates(names)
        if columns != (0, 1, 2):
            raise ValueError(f"its header names {len(names)} columns, and its rows have {width}")
    names = names if len(names) == width and header else ()
    if not names and width > 3 and _is_counted(rows, separator):
        columns = (1, 2, 3)
    if any(len(_split(row, separator)) != width for row in rows[:-1]):
        return None
    return TextLayout(first, separator, has_decimal_commas, columns, names, unit, declared)


def _is_counted(rows: list[str], separator: str | None) -> bool:
    """Return True if the first column only counts the rows, from 0 or 1 on."""
    first = [_split(row, separator)[0] for row in rows[:-1]]
    return len(first) > 2 and any(first == [str(start + k) for k in range(len(first))] for start in (0, 1))


def read_text(path: Path) -> tuple[NDArray[np.float64], NDArray[Any] | None]:
    """Return the points of a text [n, 3] [m], and their times [n] as stored, or None.

    Raises:
        Exception: it is damaged or truncated; a ValueError has a text for the user.
    """
    layout = find_text_layout(path)
    if layout is None:
        raise ValueError("it holds no rows of at least three numbers, x y z")
    _check_last_line(path, layout)
    formats = {name: "f8" for name in layout.names}
    time = time_field(formats) if layout.names else None
    columns = [*layout.columns, *([layout.names.index(time)] if time else [])]
    longest = path.stat().st_size // len("0 0 0\n") + 1
    with io.TextIOWrapper(open_user_file(path), encoding="utf-8-sig", errors="replace") as file:
        table = load_rows(
            _rows(file, layout), columns, comments=list(_COMMENTS), delimiter=layout.separator,
            max_rows=min(longest, MAP_POINTS_MAX) + 1,  # NumPy allocates memory for this many rows
        )  # fmt: skip
    check_count(len(table) if layout.declared is None else layout.declared, len(table))
    return table[:, :3] * layout.unit, table[:, 3] if time else None


def _is_row(words: list[str], header: str) -> bool:
    """Return True if there are numbers in the columns that a header names, or in the first three."""
    names = _split(header, _separator(header))
    axes = [i for i, name in enumerate(names) if _axis(name)] if len(names) == len(words) else []
    chosen = [words[i] for i in axes] if len(axes) >= 3 else words[:3]
    return len(chosen) >= 3 and all(map(_is_number, chosen))


def _rows(file: TextIO, layout: TextLayout) -> Iterator[str]:
    rows = itertools.islice(file, layout.skipped, None)
    if layout.has_decimal_commas:
        return (line.replace(",", ".") for line in rows)
    return rows


def _separator(line: str) -> str | None:
    """Return the character between the columns of a line, None for white space."""
    if ";" in line:
        return ";"
    words = line.split()
    if "," in line and len(words) >= 3 and all(re.fullmatch(r"[-+]?\d+(,\d+)?([eE][-+]?\d+)?", word) for word in words):
        return "\t" if line.count("\t") == len(words) - 1 else None  # decimal commas
    return "," if "," in line else "\t" if "\t" in line.strip() else None


def _split(line: str, separator: str | None) -> list[str]:
    words = [word.strip() for word in line.strip().split(separator)]
    return words[:-1] if words and not words[-1] else words


def _is_number(word: str) -> bool:
    try:
        float(word.replace(",", "."))
    except ValueError:
        return False
    return True


def _axis(name: str) -> tuple[str, float] | None:
    """Return x, y or z and its unit [m] for the name of a coordinate, None for another name."""
    found = _NAME_AND_UNIT.fullmatch(name.strip().strip("\"'").lower())
    plain, unit = (found[1], found[2]) if found else (name.lower(), None)
    axis = _AXIS.fullmatch(plain.strip()) if plain else None
    if axis is None or (axis[1] in "012" and ":" not in plain):
        return None
    return {"0": "x", "1": "y", "2": "z"}.get(axis[1], axis[1]), _UNITS[unit or "m"]


def _coordinates(names: tuple[str, ...]) -> tuple[tuple[int, int, int], float]:
    """Return the numbers of the columns x, y and z, and their unit [m]."""
    found: dict[str, tuple[int, float]] = {}
    for number, name in enumerate(names):
        if axis := _axis(name):
            found.setdefault(axis[0], (number, axis[1]))
    missing = [axis for axis in "xyz" if axis not in found]
    if missing:
        raise ValueError(f"its header names no {missing[0]} among {', '.join(names)[:100]}")
    if len({unit for _, unit in found.values()}) > 1:
        raise ValueError("its header gives x, y and z in different units")
    return (found["x"][0], found["y"][0], found["z"][0]), found["x"][1]


def _check_last_line(path: Path, layout: TextLayout) -> None:
    """Refuse a table of numbers whose last row has fewer columns than the one before."""
    with open_user_file(path) as file:
        file.seek(max(file.seek(0, 2) - 4096, 0))
        lines = file.read().decode("utf-8", errors="replace").splitlines()[1:]
    rows = [_split(line, layout.separator) for line in lines if line.strip()]
    if len(rows) > 1 and len(rows[-1]) < len(rows[-2]):
        raise ValueError(f"it is truncated: its last row has {len(rows[-1])} columns, and others have {len(rows[-2])}")
