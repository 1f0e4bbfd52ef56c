"""Tables of poses, and their texts: TUM, KITTI, and tables with a header such as those of EuRoC."""

from __future__ import annotations

import re
from array import array
from pathlib import Path
from typing import BinaryIO, NamedTuple

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
_TIME_WORDS = {"t", "time", "timestamp", "stamp"}
_UNIT_WORDS = {"header", "field", "s", "sec", "secs", "seconds", "ms", "us", "ns", "nsec", "nanoseconds"}
_POSITION_WORDS = {"t", "p", "pos", "position", "trans", "translation", "pose"}
_QUATERNION_WORDS = {"q", "quat", "quaternion", "orientation", "rot", "rotation"}
_UPSIDE_DOWN = -0.5
"""Cosine of the tilt below which a pose counts as upside down."""


class PoseTable(NamedTuple):
    """The poses in a file."""

    format: str
    """"TUM", "KITTI", "KITTI's oxts" or "ULog"."""
    times: NDArray[np.float64] | None
    """[n] on the file's own clock: [s], or a unit that is to be found for TUM; None for one pose per sweep."""
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


def read_pose_text(path: Path, file: BinaryIO) -> PoseTable:
    """Return the poses in a text.

    Lines have time x y z qx qy qz qw (TUM), the 12 numbers of a 3 x 4 matrix (KITTI), or the columns that a header
    names.

    Raises:
        UserError: the text holds something else.
    """
    columns, table = _read_table(path, file)
    finite = np.isfinite(table).all(axis=1)
    if not finite.all():
        raise UserError(f"{path} holds numbers that are not finite: see pose {int(np.argmin(finite)) + 1}.")
    if np.abs(table).max() > _LARGEST:
        raise UserError(f"{path} holds impossible numbers: see pose {int(np.abs(table).max(axis=1).argmax()) + 1}.")
    if columns is None and table.shape[1] == 12:
        matrices = table.reshape(-1, 3, 4)
        rotation = matrices[:, :, :3]
        if np.abs(np.linalg.det(rotation) - 1.0).max() > 0.1:
            raise UserError(f"{path} is not KITTI text: its matrices are not rotations.")
        return PoseTable("KITTI", None, matrices[:, :, 3], quaternion_of_matrix(rotation), None)
    columns = columns or _TUM
    quaternions = table[:, [columns.index(name) for name in ("qw", "qx", "qy", "qz")]]
    norms = np.linalg.norm(quaternions, axis=1)
    if (np.abs(norms - 1.0) > 0.1).any():
        line = int(np.flatnonzero(np.abs(norms - 1.0) > 0.1)[0]) + 1
        raise UserError(f"{path} is not TUM text: the quaternion of pose {line} has the length {norms[line - 1]:.2f}.")
    quaternions = quaternions / norms[:, None]
    notice = ""
    if columns is _TUM and np.median(rotation_matrix(quaternions)[:, 2, 2]) < _UPSIDE_DOWN:
        notice = (
            f"most poses of {path.name} are upside down: if its quaternions are qw qx qy qz, write the line "
            "`# time x y z qw qx qy qz` at its start"
        )
    positions = table[:, [columns.index(name) for name in "xyz"]]
    return PoseTable("TUM", table[:, columns.index("time")], positions, quaternions, None, notice=notice)


def _read_table(path: Path, file: BinaryIO) -> tuple[tuple[str, ...] | None, NDArray[np.float64]]:
    """Return the names of the columns, None without a header that has them, and the numbers in the lines of a text."""
    numbers, width, columns = array("d"), 0, None
    while line := file.readline(_LINE_MAX):
        words = line.replace(b",", b" ").replace(b";", b" ").split()
        if not words or line.startswith((b"#", b"%")):
            columns = columns or (None if width else _header(path, line))
            continue
        if not width and columns is None and (columns := _header(path, line)):
            continue
        width = width or len(words)
        expected = (8, 12) if columns is None else (len(columns),)
        if len(words) != width or width not in expected:
            layout = "8 numbers (TUM: time x y z qx qy qz qw) or 12 (KITTI)"
            layout = layout if columns is None else f"the {len(columns)} numbers that its header names"
            raise UserError(f"{path} holds no poses: every line must have {layout}.")
        try:
            numbers.extend(map(float, words))
        except ValueError as error:
            raise UserError(f"{path} holds something else than numbers: {one_line(error)}.") from error
        if len(numbers) > _NUMBERS_MAX:
            raise UserError(f"{path} holds more than {_NUMBERS_MAX // width} poses; cut it.")
    if not numbers:
        raise UserError(f"{path} holds no poses: give TUM or KITTI text, or a ULog of PX4.")
    return columns, np.frombuffer(numbers, np.float64).reshape(-1, width)


def _header(path: Path, line: bytes) -> tuple[str, ...] | None:
    """Return the names of columns in a line, as in TUM's order where they are known; None for any other comment.

    Raises:
        UserError: the line names the columns of a quaternion, but not all of those of a pose.
    """
    text = re.sub(r"\[[^]]*\]|\([^)]*\)", " ", line.decode("utf-8", errors="replace").lower()).strip().strip("#%;, ")
    names = tuple(map(_column, re.split(r"\s*[,;]\s*|\s+", text)))
    if set(names) >= set(_TUM) and all(names.count(name) == 1 for name in _TUM):
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
