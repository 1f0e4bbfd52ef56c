"""Clouds in .bin files: rows of numbers without a header, whose number of columns is found in the numbers."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_planner.user_file import open_user_file
from aero_viz.errors import UserError
from aero_viz.input_limits import SWEEP_POINTS_MAX
from aero_viz.recordings.point_cloud2 import valid_points

_SAMPLED = 5
"""Number of files from which the layout of a folder is found."""
_SAMPLE_BYTES = 240_000
"""Largest part of each that is looked at; whole rows of every layout."""
_FITTING = 0.9
"""Part of the files whose size a layout has to fit; others may be truncated."""
_TINY = 1e-6
"""Smaller coordinates than this that are not zero are no lengths [m], but bytes of something else."""
_DISTINCT, _NEARLY = 0.02, 0.85


class BinLayout(NamedTuple):
    """The rows of a file: x, y, z and further columns."""

    columns: int
    dtype: str
    """Type of the numbers, "<f4" or "<f8"."""

    @property
    def size(self) -> int:
        """Length of a row [bytes]."""
        return self.columns * np.dtype(self.dtype).itemsize

    @property
    def is_common(self) -> bool:
        """True for the rows of KITTI (x, y, z, intensity) and nuScenes (.. and ring)."""
        return self.dtype == "<f4" and self.columns in (4, 5)

    def __str__(self) -> str:
        return f"{self.columns} numbers, float{8 * np.dtype(self.dtype).itemsize}"


_LAYOUTS = [BinLayout(4, "<f4"), BinLayout(5, "<f4"), BinLayout(3, "<f4"), BinLayout(6, "<f4")]
_LAYOUTS += [BinLayout(columns, "<f8") for columns in (4, 3, 5, 6)] + [BinLayout(7, "<f4"), BinLayout(8, "<f4")]
"""The layouts that are known, of which an earlier one is preferred where two fit about as well."""


def find_layout(files: list[Path]) -> BinLayout:
    """Return the layout of files, all of which have the same.

    Of the layouts that fit the sizes of the files and give plausible points, it is the one whose columns differ most:
    rows that are cut at the wrong places mix the columns.

    Raises:
        UserError: a file cannot be read, none of the layouts fits their sizes, or none gives plausible points.
    """
    sizes = np.array([file.stat().st_size for file in files])
    sizes = sizes[sizes > 0]
    fitting = [layout for layout in _LAYOUTS if len(sizes) and np.mean(sizes % layout.size == 0) >= _FITTING]
    if not fitting:
        raise UserError(
            f"{files[0]} is not a cloud of KITTI or nuScenes: its {files[0].stat().st_size} bytes are not rows of 3 to "
            "8 numbers, x y z first, in float32 or float64, or other files in its folder are not."
        )
    picked = np.unique(np.linspace(0, len(files) - 1, _SAMPLED).round().astype(int))
    samples, errors = [], []
    for index in picked:
        try:
            samples.append(_read(files[index], _SAMPLE_BYTES))
        except UserError as error:
            errors.append(error)
    if not samples:
        raise errors[0]
    scores = {layout: _distinctness(samples, layout) for layout in fitting}
    scores = {layout: score for layout, score in scores.items() if score is not None}
    if not scores:
        raise _implausible(files[picked[0]])
    best = max(scores.values())
    if best < _DISTINCT and BinLayout(3, "<f4") in scores:  # an intensity would differ from the coordinates
        return BinLayout(3, "<f4")
    return next(layout for layout, score in scores.items() if score >= _NEARLY * best)


def read_bin(path: Path, layout: BinLayout) -> NDArray[np.float64]:
    """Return the points of a cloud [n, 3] [m].

    Raises:
        UserError: the file cannot be read, has another size than such a cloud, or holds implausible points.
    """
    data = _read(path, layout.size * SWEEP_POINTS_MAX + 1)
    if not data or len(data) % layout.size:
        raise UserError(
            f"{path} is not a cloud like the others: its {path.stat().st_size} bytes are not rows of {layout}, or too "
            "many; it may be truncated."
        )
    points = np.frombuffer(data, layout.dtype).reshape(-1, layout.columns)[:, :3]
    if not _is_plausible(points):
        raise _implausible(path)
    return points.astype(np.float64)


def _read(path: Path, limit: int) -> bytes:
    try:
        with open_user_file(path) as file:
            return file.read(limit)
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror or error}.") from error


def _implausible(path: Path) -> UserError:
    return UserError(
        f"{path} is not a cloud of KITTI or nuScenes: most of its points are not finite or lie beyond the range of any "
        "LiDAR; give a file with rows of x, y, z [m] and intensity, in float32."
    )


def _is_plausible(points: NDArray[np.floating]) -> bool:
    """Return True if at least half of the points that are not zero may be returns of a LiDAR."""
    with np.errstate(all="ignore"):  # the bytes may not be numbers
        points = points.astype(np.float32)
        returns = (points != 0).any(axis=1)
        tiny = ((np.abs(points) < _TINY) & (points != 0)).any(axis=1)
        return bool(2 * np.count_nonzero(valid_points(points) & ~tiny) >= np.count_nonzero(returns))


def _distinctness(samples: list[bytes], layout: BinLayout) -> float | None:
    """Return how much the columns differ, 0 to 1; None if the points are implausible.

    It is the part of the variance of the numbers' size, sign and kind that their columns explain.
    """
    whole = b"".join(data[: len(data) // layout.size * layout.size] for data in samples)
    table = np.frombuffer(whole, layout.dtype).reshape(-1, layout.columns)
    if not len(table) or not _is_plausible(table[:, :3]):
        return None
    with np.errstate(all="ignore"):
        values = np.arcsinh(np.clip(np.nan_to_num(table.astype(np.float64)), -1e9, 1e9))
        whole_numbers, fractions = table == np.floor(table), (table >= 0) & (table <= 1)
    shares = []
    for feature in (values, np.abs(values), whole_numbers.astype(float), fractions.astype(float)):
        if variance := float(feature.var()):
            shares.append(float(feature.mean(axis=0).var()) / variance)
    return float(np.mean(shares)) if shares else 0.0
