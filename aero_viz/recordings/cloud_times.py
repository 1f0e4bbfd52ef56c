"""The times of the clouds of a folder: from a text next to them, or from the numbers and dates in their names."""

from __future__ import annotations

import contextlib
import itertools
import math
import re
from collections.abc import Sequence
from datetime import datetime, timezone
from decimal import Decimal
from pathlib import Path
from typing import NamedTuple

from aero_planner.user_file import read_user_text
from aero_viz.errors import UserError
from aero_viz.input_limits import TEXT_MAX
from aero_viz.recordings.bag_file import one_line

STAMP_END = 10**9 << 31
"""Times from here on do not fit into a header [ns]."""
FIRST_STAMP = 1_000_000_000
"""Stamp of the first cloud where none is known [ns]; zero would mean that it is unset. Times that are not since 1970
are counted from it."""
SINCE_1970 = 10**17
"""Smallest stamp that is a time since 1970 [ns]."""
_PERIOD = 100_000_000
"""Time between two clouds where none is known [ns]."""
_TIMES = ("times.txt", "timestamps.txt")
_DATE = re.compile(r"\d{4}-\d\d-\d\d ")
"""Start of a date and a time of day (UTC), as in KITTI's raw data."""
_DATE_IN_NAME = re.compile(
    r"(?:^|\D)((?:19|20)\d\d)[-_.]?(\d\d)[-_.]?(\d\d)[-_T. ]{0,2}(\d\d)[-_.:h]?(\d\d)[-_.:m]?(\d\d)"
    r"(?:[-_.s]?(\d{1,9}))?(?:\.pcd)?$"
)
"""A date and a time of day at the end of a name, with decimals of the seconds."""
_NUMBER_IN_NAME = re.compile(
    r"(?:^|\D)(?:(1\d{9}(?=[-_])|\d{1,10}(?=_\d{9}(?:\D|$)))[-_](\d{1,9})|(\d{1,10}\.\d{1,9})|(\d{1,19}))(?:\.pcd)?$"
)
"""A number at the end of a name: seconds and parts of one, seconds with decimals, or a whole number."""
_LARGEST = 10**20
"""Larger numbers are no times in any unit."""
_DIGITS = 10**8
"""Most whole numbers are at least this large, if they are times and not counters."""
_UNITS = {10**9: "seconds", 10**6: "milliseconds", 10**3: "microseconds", 1: "nanoseconds"}
"""Units by their lengths [ns]."""
_YEAR_2005 = 1_104_537_600 * 10**9
"""Recordings are not older [ns]."""
_USUAL_STEP = 0.1
"""Time between two sweeps that is expected [s]."""
_STEPS, _STEPS_SINCE_1970 = (5e-3, 20.0), (1e-4, 3600.0)
"""Shortest and longest time between two clouds [s]."""
_SINCE_1970_COUNTS = 2.2
"""As many decades of the time between two clouds as it tells that numbers are times of this century."""


class Clock(NamedTuple):
    """What numbers count."""

    unit: int
    """[ns]."""
    is_since_1970: bool

    def stamp(self, value: Decimal) -> int:
        """Return the stamp of a number [ns]."""
        return max(int(value * self.unit), 0) + (0 if self.is_since_1970 else FIRST_STAMP)

    def __str__(self) -> str:
        return f"in {_UNITS[self.unit]} {'since 1970' if self.is_since_1970 else 'of a clock that starts elsewhere'}"


def find_clock(values: Sequence[Decimal], units: Sequence[int] = tuple(_UNITS)) -> Clock | None:
    """Return what the times of clouds count, None if they make no sense as times.

    The unit is the one in which the clouds follow one another like sweeps, preferably in this century.
    """
    ordered = sorted(set(values))
    if ordered[-1] > _LARGEST:
        return None
    steps = sorted(after - before for before, after in itertools.pairwise(ordered))
    step = float(steps[len(steps) // 2]) if steps else None
    found: list[tuple[float, Clock]] = []
    for unit in units:
        clock = Clock(unit, ordered[0] * unit >= _YEAR_2005)
        if not ordered[0] >= 0 or clock.stamp(ordered[-1]) >= STAMP_END:
            continue
        if step is None:
            found += [(0.0, clock)] if clock.is_since_1970 else []
            continue
        seconds = step * unit * 1e-9
        low, high = _STEPS_SINCE_1970 if clock.is_since_1970 else _STEPS
        if low <= seconds <= high:
            found.append((abs(math.log10(seconds / _USUAL_STEP)) - _SINCE_1970_COUNTS * clock.is_since_1970, clock))
    return min(found, key=lambda item: item[0])[1] if found else None


def order_clouds(files: list[Path], places: list[Path]) -> tuple[list[Path], list[int], str]:
    """Return the files in the order of time, their stamps [ns], and a notice on where these are from.

    Args:
        files: clouds.
        places: folders in which there may be a text with the times of the sorted files.

    Raises:
        UserError: the text cannot be read, or does not fit the files.
    """
    files = sorted(files, key=_natural)
    text = next((place / name for place in places for name in _TIMES if (place / name).is_file()), None)
    if text is not None:
        stamps, clock = _stamps_and_clock(text, files)
        return files, stamps, f"times are those of {text.name}, {clock}" if clock else ""
    stamps_of, notice = stamps_in_names(files)
    if len(stamps_of) == len(files) > 0:
        return sorted(files, key=lambda file: stamps_of[file]), sorted(stamps_of.values()), notice
    notice = "no times are recorded: the clouds are assumed to be 0.1 s apart" if len(files) > 1 else ""
    return files, [FIRST_STAMP + _PERIOD * i for i in range(len(files))], notice


def stamps_in_names(files: list[Path]) -> tuple[dict[Path, int], str]:
    """Return the stamps [ns] of the files whose names end in a time, none if those of most files do not; and a notice.

    These are dates, or numbers which `find_clock` understands. Counters are none of these.
    """
    dates = {file: stamp for file in files if (stamp := _date_in(file.stem)) is not None}
    if len(dates) > len(files) // 2:
        return dates, "times are the dates in the names of the files"
    found = {file: match for file in files if (match := _NUMBER_IN_NAME.search(file.stem))}
    parts = [match[2] for match in found.values() if match[1]]
    digits = len(parts[0]) if len(set(map(len, parts))) == 1 else 9  # without zeros before them, they are nanoseconds
    counted = sorted(map(int, parts))
    is_counter = len(parts) > 1 and counted == list(range(counted[0], counted[0] + len(parts)))
    exact = {
        file: Decimal(f"{m[1]}.{m[2].zfill(digits)}" if m[1] else m[3])
        for file, m in found.items()
        if (m[1] and not is_counter) or m[3]
    }
    whole = {file: Decimal(m[4]) for file, m in found.items() if m[4] and (m[4] == "0" or m[4][0] != "0")}
    for numbers in (exact, whole):
        large = [value for value in numbers.values() if value >= _DIGITS]
        if len(numbers) <= len(files) // 2 or (numbers is whole and len(large) <= len(numbers) // 2):
            continue
        if numbers is exact and not large and not all(_is_decimal(file.stem) for file in numbers):
            continue  # numbers of versions
        clock = find_clock(list(numbers.values()), (10**9,) if numbers is exact else tuple(_UNITS))
        if clock is not None and (clock.unit < 10**9 or clock.is_since_1970 or numbers is exact):
            return {file: clock.stamp(value) for file, value in numbers.items()}, (
                f"times are the numbers in the names of the files, {clock}"
            )
    return {}, ""


def number_in_name(file: Path) -> int | None:
    """Return the last whole number in the name of a cloud, such as 4 for 000004.bin; None without one."""
    found = re.findall(r"\d{1,18}", file.stem)
    return int(found[-1]) if found else None


def read_stamps(path: Path, files: list[Path]) -> list[int]:
    """Return the times in a text [ns], one per file; where files are missing, their names are numbers of lines.

    Raises:
        UserError: the text cannot be read, or does not fit the files.
    """
    return _stamps_and_clock(path, files)[0]


def _stamps_and_clock(path: Path, files: list[Path]) -> tuple[list[int], Clock | None]:
    """Return the times in a text [ns], and what its numbers count; None for dates."""
    try:
        text = read_user_text(path, limit=TEXT_MAX)
        values, is_date = _times_in(text)
        if not all(value.is_finite() for value in values):
            raise ValueError("one of them is not finite")
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror or error}.") from error
    except ValueError as error:
        problem = one_line(error)[:200]
        raise UserError(f"{path} must hold one time or date per line ({problem}); correct or remove it.") from error
    if len(values) != len(files):
        lines = [int(file.stem) if file.stem.isdecimal() else len(values) for file in files]
        if max(lines) >= len(values):
            raise UserError(f"{path} holds {len(values)} times for {len(files)} clouds; correct or remove it.")
        values = [values[line] for line in lines]
    seconds = Clock(10**9, bool(values) and values[0] * 10**9 >= _YEAR_2005)
    clock = seconds if is_date else find_clock(values) or seconds
    if max(values) > _LARGEST or max(map(clock.stamp, values)) >= STAMP_END:
        raise UserError(f"{path} holds a time that is beyond 2038; correct or remove it.")
    return list(map(clock.stamp, values)), None if is_date else clock


def _times_in(text: str) -> tuple[list[Decimal], bool]:
    """Return the times in the lines of a text, and whether they are dates.

    They may be a column of numbers next to which others may have names. Comments and a header are skipped. A column
    that only counts the lines is no time unless it is the only one.

    Raises:
        ValueError: a line is none of these.
    """
    lines = [line.strip() for line in text.splitlines() if line.strip() and line.strip()[0] not in "#%"]
    if lines and _DATE.match(lines[0]):
        dates = [datetime.fromisoformat(line[:26]).replace(tzinfo=timezone.utc) for line in lines]
        return [Decimal(repr(date.timestamp())) for date in dates], True
    rows = [re.split(r"[,;\s]+", line) for line in lines]
    if len(rows) > 1 and not any(map(_is_number, rows[0])) and any(map(_is_number, rows[1])):
        del rows[0]
    columns = [column for column in zip(*rows, strict=False) if any(map(_is_number, column))] or [
        [row[0] for row in rows]
    ]
    try:
        numbers = [list(map(Decimal, column)) for column in columns]
    except ArithmeticError:
        word = next(word for column in columns for word in column if not _is_number(word))
        raise ValueError(f"{word!r} is no number") from None
    counts = [[first + i for i in range(len(rows))] for first in (0, 1)]
    return next((column for column in numbers if column not in counts), numbers[0]), False


def _is_number(word: str) -> bool:
    with contextlib.suppress(ArithmeticError):
        return bool(Decimal(word) or True)
    return False


def _is_decimal(text: str) -> bool:
    """Return True for seconds, such as 12.340000, and nothing else."""
    return bool(re.fullmatch(r"\d+(\.\d{2,9}|_\d{9})", text))


def _date_in(text: str) -> int | None:
    """Return the date at the end of a name as a time since 1970 [ns], UTC; None if there is none."""
    found = _DATE_IN_NAME.search(text)
    if found is None:
        return None
    with contextlib.suppress(ValueError):
        date = datetime(*map(int, found.groups()[:6]), tzinfo=timezone.utc)  # type: ignore[arg-type]
        stamp = int(date.timestamp()) * 10**9 + int((found[7] or "").ljust(9, "0"))
        return stamp if _YEAR_2005 <= stamp < STAMP_END else None
    return None


def _natural(file: Path) -> tuple[tuple[str, float], ...]:
    """Return a key that sorts numbers in names by their values: 9 before 10, and 0.9 before 1.0."""
    try:
        return (("", float(file.stem)),)
    except ValueError:
        return tuple((text, float(number or 0)) for text, number in re.findall(r"(\D*)(\d{0,300})", file.stem))
