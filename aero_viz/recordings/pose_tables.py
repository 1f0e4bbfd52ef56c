"""Tables of poses, and their texts: TUM, KITTI, and tables with a header such as those of EuRoC."""

from __future__ import annotations

import re
from array import array
from pathlib import Path
from typing import BinaryIO, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_planner.quaternions import quaternion_of_matrix, rotation_matrix
from aero_viz.errors import UserError
from aero_viz.recordings.bag_file import one_line

_LINE_MAX = 4096  # [bytes]
_NUMBERS_MAX = 1 << 26
_LARGEST = 1e19
"""Largest number in a table of poses, which is a time since 1970 [ns]."""
_TUM = ("time", "x", "y", "z", "qx", "qy", "qz", "qw")
_OF_A_POSE = {*_TUM, "sec", "nsec"}
"""Columns that are read where a header names them."""
_WIDTHS = (7, 8, 9, 12, 13, 16, 17)
"""Numbers of columns that are known without a header."""
_COUNTED_MAX = 1e7
"""Whole numbers below this that increase are numbers of clouds and no times."""
_TIME_WORDS = {"t", "time", "timestamp", "stamp"}
_SECONDS, _NANOSECONDS = {"s", "sec", "secs", "seconds"}, {"ns", "nsec", "nsecs", "nanosec", "nanosecs", "nanoseconds"}
_UNIT_WORDS = {"header", "field", "ms", "us", "", *_SECONDS, *_NANOSECONDS}
_POSITION_WORDS = {"t", "p", "pos", "position", "trans", "translation", "pose"}
_QUATERNION_WORDS = {"q", "quat", "quaternion", "orientation", "rot", "rotation"}
_UPSIDE_DOWN = -0.5
"""Cosine of the tilt below which a pose counts as upside down."""


class PoseTable(NamedTuple):
    """The poses in a file."""

    format: str
    """Name of the format, such as "TUM", "KITTI" or "ULog"."""
    times: NDArray[np.float64] | None
    """[n] on the file's own clock; None for one pose per sweep."""
    positions: NDArray[np.float64]
    """[n, 3] [m], world z up."""
    quaternions: NDArray[np.float64]
    """[n, 4] w, x, y, z."""
    twists: NDArray[np.float64] | None
    """Velocities in the body frame [n, 3] [m/s]."""
    utc: float | None = None
    """Time since 1970 at time 0 of the file's clock [s], None where it is not known."""
    notice: str = ""
    """Sentence about what is odd; empty if nothing is."""
    numbers: NDArray[np.int64] | None = None
    """Numbers of the clouds of the poses [n], where the file has them in place of times."""
    is_in_seconds: bool = False
    """True if the unit of the times is known."""


def read_pose_text(path: Path, file: BinaryIO) -> PoseTable:
    """Return the poses in a text.

    Lines have the columns that a header names, or those of one of `_LAYOUTS`.

    Raises:
        UserError: the text holds something else.
    """
    columns, table = _read_table(path, file)
    finite = np.isfinite(table).all(axis=1)
    if not finite.all():
        raise UserError(f"{path} holds numbers that are not finite: see pose {int(np.argmin(finite)) + 1}.")
    if np.abs(table).max() > _LARGEST:
        raise UserError(f"{path} holds impossible numbers: see pose {int(np.abs(table).max(axis=1).argmax()) + 1}.")
    layout = _find_layout(table) if columns is None else _Layout("TUM", columns)
    if layout.columns is None:
        return _matrices(path, table, layout)
    table, columns = _with_time(table, layout.columns)
    quaternions = table[:, [columns.index(name) for name in ("qw", "qx", "qy", "qz")]]
    norms = np.linalg.norm(quaternions, axis=1)
    if (np.abs(norms - 1.0) > 0.1).any():
        line = int(np.flatnonzero(np.abs(norms - 1.0) > 0.1)[0]) + 1
        raise UserError(f"{path} is not TUM text: the quaternion of pose {line} has the length {norms[line - 1]:.2f}.")
    quaternions = quaternions / norms[:, None]
    notice = ""
    if layout.columns is _TUM and np.median(rotation_matrix(quaternions)[:, 2, 2]) < _UPSIDE_DOWN:
        notice = (
            f"most poses of {path.name} are upside down: if its quaternions are qw qx qy qz, write the line "
            "`# time x y z qw qx qy qz` at its start"
        )
    positions = table[:, [columns.index(name) for name in "xyz"]]
    times = table[:, columns.index("time")] if "time" in columns else None
    return PoseTable(layout.format, times, positions, quaternions, None, notice=notice)


class _Layout(NamedTuple):
    """The columns of a text of poses."""

    format: str
    columns: tuple[str, ...] | None
    """Names of the columns; None for the numbers of a matrix."""
    first: Literal["", "time", "number"] = ""
    """What precedes the numbers of a matrix."""


def _find_layout(table: NDArray[np.float64]) -> _Layout:
    """Return the layout of a text without a header, by the number of its columns."""
    width, start = table.shape[1], table[:, 0]
    is_counted = bool((start == np.round(start)).all() and (np.diff(start) > 0).all() and start.max() < _COUNTED_MAX)
    if width == 7:
        return _Layout("text without times", _TUM[1:])
    if width == 9:
        pairs = table[:, :2]
        is_split = bool((pairs == np.round(pairs)).all() and (pairs[:, 1] >= 0).all() and (pairs[:, 1] < 1e9).all())
        return _Layout("TUM", ("sec", "nsec", *_TUM[1:]) if is_split and not is_counted else ("number", *_TUM))
    if width in (13, 17):
        first = "number" if is_counted else "time"
        return _Layout(f"{first}s and matrices", None, first)
    return _Layout("TUM", _TUM) if width == 8 else _Layout("KITTI", None)


def _matrices(path: Path, table: NDArray[np.float64], layout: _Layout) -> PoseTable:
    """Return poses from matrices of three or four rows, one in each line."""
    first, numbers = (table[:, 0], table[:, 1:]) if layout.first else (None, table)
    matrices = numbers.reshape(len(table), -1, 4)
    rotation = matrices[:, :3, :3]
    if np.abs(np.linalg.det(rotation) - 1.0).max() > 0.1:
        raise UserError(f"{path} is not KITTI text: its matrices are not rotations.")
    frames = None if first is None or layout.first == "time" else first.astype(np.int64)
    times = first if layout.first == "time" else None
    return PoseTable(layout.format, times, matrices[:, :3, 3], quaternion_of_matrix(rotation), None, numbers=frames)


def _with_time(table: NDArray[np.float64], columns: tuple[str, ...]) -> tuple[NDArray[np.float64], tuple[str, ...]]:
    """Return a table whose time is one column [s], where it is in two: seconds and nanoseconds."""
    if "sec" not in columns or "nsec" not in columns:
        return table, columns
    times = table[:, columns.index("sec")] + 1e-9 * table[:, columns.index("nsec")]
    return np.column_stack([times, table]), ("time", *columns)


def _read_table(path: Path, file: BinaryIO) -> tuple[tuple[str, ...] | None, NDArray[np.float64]]:
    """Return the names of the columns of a pose, None without a header that has them, and the numbers in them."""
    numbers, width, columns = array("d"), 0, None
    while line := file.readline(_LINE_MAX):
        words = _words(line)
        if not words or line.startswith((b"#", b"%")):
            columns = columns or (None if width else _header(path, line))
            continue
        if not width and columns is None and (columns := _header(path, line)):
            continue
        width = width or len(words)
        expected = _WIDTHS if columns is None else (len(columns),)
        if len(words) != width or width not in expected:
            layout = (
                "8 numbers (TUM: time x y z qx qy qz qw), 9 (sec nsec x y z qx qy qz qw), 12 or 16 (a matrix, KITTI), "
                "or 13 or 17 (time and matrix), or a header must name them"
            )
            layout = layout if columns is None else f"the {len(columns)} numbers that its header names"
            raise UserError(f"{path} holds no poses: every line must have {layout}.")
        if columns is not None:  # others may be texts or covariances
            words = [word for word, name in zip(words, columns, strict=True) if name in _OF_A_POSE]
        try:
            numbers.extend(map(float, words))
        except ValueError as error:
            raise UserError(f"{path} holds something else than numbers: {_first_text(words)!r}.") from error
        if len(numbers) > _NUMBERS_MAX:
            raise UserError(f"{path} holds more than {_NUMBERS_MAX // width} poses; cut it.")
    if not numbers:
        raise UserError(f"{path} holds no poses: give TUM or KITTI text, or a ULog of PX4.")
    if columns is not None:
        columns = tuple(name for name in columns if name in _OF_A_POSE)
    return columns, np.frombuffer(numbers, np.float64).reshape(-1, width if columns is None else len(columns))


def _first_text(words: list[bytes]) -> str:
    """Return the first of some words that is no number."""
    for word in words:
        try:
            float(word)
        except ValueError:
            return word[:60].decode("utf-8", errors="replace")
    return ""


def _words(line: bytes) -> list[bytes]:
    """Return the words of a line; between commas or semicolons there may be none."""
    separator = next((mark for mark in (b",", b";") if mark in line), None)
    words = [word.strip() for word in line.strip().split(separator)]
    return words if words and words[-1] else words[:-1]


def _header(path: Path, line: bytes) -> tuple[str, ...] | None:
    """Return the names of columns in a line, as in TUM's order where they are known; None for any other comment.

    Raises:
        UserError: the line names the columns of a quaternion, but not all of those of a pose.
    """
    text = re.sub(r"\[[^]]*\]|\([^)]*\)", " ", line.decode("utf-8", errors="replace").lower()).strip().strip("#%;, ")
    found = re.split(r"\s*[,;]\s*|\s+", text)
    names = tuple(map(_column, found))
    if names.count("time") > 1:  # that of recording, and the stamp
        stamp = max(i for i, name in enumerate(names) if name == "time")
        names = tuple("" if name == "time" and i != stamp else name for i, name in enumerate(names))
    if "time" not in names:  # in two columns
        names = tuple(_part_of_time(word) or name for word, name in zip(found, names, strict=True))
        names = tuple("time" if name == "sec" and "nsec" not in names else name for name in names)
        timed = ("sec", "nsec", *_TUM[1:]) if "nsec" in names else _TUM
    else:
        timed = _TUM
    if set(names) >= set(timed) and all(names.count(name) == 1 for name in timed):
        return names
    if any(name in names for name in ("qw", "qx", "qy", "qz")) and len(names) >= len(_TUM) - 1:
        raise UserError(
            f"{path} has a header that does not name all columns of a pose, {one_line(ValueError(text))[:120]!r}: name "
            "them time x y z qx qy qz qw, in the order of the file."
        )
    return None


def _column(name: str) -> str:
    """Return the name of a column in TUM's terms, or the name itself where it is another quantity."""
    words = re.split(r"[._/]+", re.sub(r"^([ptq])([wxyz])$", r"\1_\2", name.strip("'\"")))
    *kinds, axis = words
    if not _TIME_WORDS.isdisjoint(words) and set(words) <= _TIME_WORDS | _UNIT_WORDS:
        return "time"
    if axis in tuple("wxyz") and not _QUATERNION_WORDS.isdisjoint(kinds):
        return f"q{axis}"
    return axis if axis in tuple("xyz") and (not kinds or not _POSITION_WORDS.isdisjoint(kinds)) else name


def _part_of_time(name: str) -> str:
    """Return "sec" or "nsec" for the name of a column with one part of the time, empty for another name."""
    *kinds, last = re.split(r"[._/]+", name.strip("'\""))
    if not set(kinds) <= _TIME_WORDS | _UNIT_WORDS:
        return ""
    return "sec" if last in _SECONDS else "nsec" if last in _NANOSECONDS else ""
