"""Clouds in .bin files: rows of numbers without a header, whose number of columns is found in the numbers."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_planner.user_file import open_user_file
from aero_viz.errors import UserError
from aero_viz.input_limits import SWEEP_POINTS_MAX
from aero_viz.recordings.point_cloud2 import valid_points
from aero_viz.scenes.decoder_checks import refuse_pointer

_SAMPLED = 5
"""Number of files from which the layout of a folder is found."""
_SAMPLE_BYTES = 221_760
"""Largest part of each that is looked at; whole rows of every layout."""
_FITTING = 0.9
"""Part of the files whose size a layout has to fit; others may be truncated."""
_TINY = 1e-6
"""Smaller coordinates than this that are not zero are no lengths [m], but bytes of something else."""
_SOUND = 0.9
"""Least share of lengths in each of x, y and z."""
_MANTISSA_BITS, _MANY = 2, 4000
"""Bits of the mantissa that tell numbers of a column apart, where there are many numbers, and how many that are."""
_GAIN, _GAIN_OF_SCAN = 0.25, 1.5
"""A layout of two or more points per row has to save this many bits per number; more where its points follow one
another in a scan, whose lasers or returns alternate."""
_SAME_BEARING, _BEARINGS = 0.95, 0.8
"""Cosine between the bearings of two neighbours in a scan, and the share of such neighbours."""
_COLUMNS_MAX = 64
_NUMBERS = {"f4": "float32", "f8": "float64"}


class BinLayout(NamedTuple):
    """The rows of a file: x, y, z and further columns."""

    types: tuple[str, ...]
    """NumPy's codes of the numbers, such as "f4"; little endian."""

    @property
    def dtype(self) -> np.dtype:
        """The type of a row."""
        return np.dtype([(f"{i}", f"<{code}") for i, code in enumerate(self.types)])

    @property
    def size(self) -> int:
        """Length of a row [bytes]."""
        return self.dtype.itemsize

    def points(self, data: bytes) -> NDArray[np.floating]:
        """Return x, y, z [n, 3] of whole rows."""
        if len(set(self.types)) == 1:
            return np.frombuffer(data, f"<{self.types[0]}").reshape(-1, len(self.types))[:, :3]
        rows = np.frombuffer(data, self.dtype)
        return np.stack([rows[f"{i}"] for i in range(3)], axis=1)

    def __str__(self) -> str:
        if len(set(self.types)) == 1:
            return f"{len(self.types)} numbers, {_NUMBERS[self.types[0]]}"
        if set(self.types[3:]) == {"u1"}:
            return f"{self.size} bytes, {_NUMBERS[self.types[0]]}"
        return f"{len(self.types)} numbers, {','.join(self.types)}"


_LAYOUTS = {code: [BinLayout((code,) * n) for n in range(3, last + 1)] for code, last in (("f4", 12), ("f8", 8))}
"""Rows of one type of numbers, by that type."""
_MIXED = {
    code: [BinLayout((code,) * 3 + ("u1",) * n) for n in range(1, 49 - length * 3) if n % length]
    for code, length in (("f4", 4), ("f8", 8))
}
"""Rows of up to 48 bytes that have other numbers behind x, y, z. What these are does not matter."""


def parse_columns(text: str) -> BinLayout:
    """Return the layout that a text describes: "5" for float32, or NumPy's codes such as "4f8" or "4f4,u2,f4".

    Raises:
        UserError: it describes none.
    """
    types: list[str] = []
    for part in re.split(r"[,\s]+", text.strip()):
        found = re.fullmatch(r"(\d{0,2})([fiu][1248])?", part)
        if found is None or not part:
            types = []
            break
        types += [found[2] or "f4"] * int(found[1] or 1)
    known = all(code in ("f4", "f8") or code[0] in "iu" for code in types)
    if not 3 <= len(types) <= _COLUMNS_MAX or not known or any(code not in _NUMBERS for code in types[:3]):
        raise UserError(
            f"--columns {text!r} describes no rows: give their number of float32 columns, such as 5, or NumPy's types, "
            "such as 4f8 or 4f4,u2,f4; x, y, z come first, as f4 or f8."
        )
    return BinLayout(tuple(types))


def find_layout(files: list[Path]) -> BinLayout:
    """Return the layout of files, all of which have the same.

    Of the layouts that fit the sizes of the files and whose x, y and z are lengths, it is the one whose columns take
    the fewest bits if each has a code of its own: rows that are cut at the wrong places mix the columns, and more
    columns than there are need more codes. Bytes that are no whole number of such numbers need no comparison: x, y, z
    are lengths in no other rows.

    Raises:
        UserError: a file cannot be read, none of the layouts fits their sizes, or none gives plausible points.
    """
    sizes = np.array([file.stat().st_size for file in files])
    sizes = sizes[sizes > 0]
    samples = _samples(files)

    def sound(layouts: list[BinLayout]) -> list[BinLayout]:
        fits = [layout for layout in layouts if len(sizes) and np.mean(sizes % layout.size == 0) >= _FITTING]
        return [layout for layout in fits if _holds_lengths(samples, layout)]

    for code in _LAYOUTS:  # float64 read as float32 gives no lengths; the reverse sometimes does
        if mixed := sound(_MIXED[code]):
            return mixed[0]
        if costs := {layout: _bits(samples, layout) for layout in sound(_LAYOUTS[code])}:
            return _without_repeats(samples, costs)
    raise _implausible(files[0])


def read_bin(path: Path, layout: BinLayout) -> NDArray[np.float64]:
    """Return the points of a cloud [n, 3] [m].

    Raises:
        UserError: the file cannot be read, has another size than such a cloud, or holds implausible points.
    """
    data = _read(path, layout.size * SWEEP_POINTS_MAX + 1)
    if not data or len(data) % layout.size:
        raise UserError(
            f"{path} is not a cloud of these columns: its {path.stat().st_size} bytes are not rows of {layout}, or too "
            "many; it may be truncated."
        )
    points = layout.points(data)
    if not _is_plausible(points):
        raise _implausible(path)
    return points.astype(np.float64)


def _samples(files: list[Path]) -> list[bytes]:
    samples, errors = [], []
    for index in np.unique(np.linspace(0, len(files) - 1, _SAMPLED).round().astype(int)):
        try:
            samples.append(_read(files[index], _SAMPLE_BYTES))
        except UserError as error:
            errors.append(error)
    if not samples:
        raise errors[0]
    return samples


def _read(path: Path, limit: int) -> bytes:
    try:
        refuse_pointer(path)
        with open_user_file(path) as file:
            return file.read(limit)
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror or error}.") from error


def _implausible(path: Path) -> UserError:
    return UserError(
        f"{path} is not a cloud of KITTI or nuScenes: its {path.stat().st_size} bytes, or those of its neighbours, are "
        "no rows that start with x, y, z within the range of any LiDAR [m], in float32 or float64; --columns names "
        "other rows."
    )


def _is_plausible(points: NDArray[np.floating]) -> bool:
    """Return True if at least half of the points that are not zero may be returns of a LiDAR."""
    with np.errstate(all="ignore"):  # the bytes may not be numbers
        points = points.astype(np.float32)
        returns = (points != 0).any(axis=1)
        tiny = ((np.abs(points) < _TINY) & (points != 0)).any(axis=1)
        return bool(2 * np.count_nonzero(valid_points(points) & ~tiny) >= np.count_nonzero(returns))


def _table(samples: list[bytes], layout: BinLayout) -> NDArray[np.floating]:
    """Return the whole rows of the samples in a layout of one type [n, columns]."""
    return np.frombuffer(_rows(samples, layout), f"<{layout.types[0]}").reshape(-1, len(layout.types))


def _rows(samples: list[bytes], layout: BinLayout) -> bytes:
    return b"".join(data[: len(data) // layout.size * layout.size] for data in samples)


def _holds_lengths(samples: list[bytes], layout: BinLayout) -> bool:
    """Return True if x, y and z hold lengths, each of them nearly everywhere, and x and y are not always zero."""
    with np.errstate(all="ignore"):
        points = layout.points(_rows(samples, layout)).astype(np.float64)
        points = points[np.isfinite(points).any(axis=1) & (points != 0).any(axis=1)]  # without "no return"
        axes = [np.abs(column[:, None]) for column in points.T]
        sound = [valid_points(np.tile(axis, 3)) & (axis[:, 0] >= _TINY) | (axis[:, 0] == 0) for axis in axes]
    return bool(len(points) and min(map(np.mean, sound)) >= _SOUND and points[:, :2].any(axis=0).all())


def _bits(samples: list[bytes], layout: BinLayout) -> float:
    """Return the bits per number that adaptive codes of the columns take (Krichevsky and Trofimov's estimator).

    A number counts as its sign, exponent, first bits of its mantissa, and whether the last ones are zero, as those of
    whole numbers are.
    """
    from scipy.special import gammaln

    table = _table(samples, layout)
    with np.errstate(all="ignore"):
        words = table.astype(np.float32).view(np.uint32).reshape(-1)
    shift = np.uint32(23 - (_MANTISSA_BITS if len(words) > _MANY else 0))
    symbols = np.unique(2 * (words >> shift) + ((words & np.uint32(0xFFF)) == 0), return_inverse=True)[1]
    kinds, total = int(symbols.max()) + 1, 0.0
    for column in symbols.reshape(table.shape).T:
        counts = np.bincount(column, minlength=kinds)
        total -= gammaln(counts + 0.5).sum() - kinds * gammaln(0.5)
        total -= gammaln(0.5 * kinds) - gammaln(len(column) + 0.5 * kinds)
    return float(total / np.log(2.0) / table.size)


def _without_repeats(samples: list[bytes], costs: dict[BinLayout, float]) -> BinLayout:
    """Return the cheapest layout or, where each of its rows holds several points, that of a single one."""
    best = min(costs, key=lambda layout: costs[layout])
    for layout, cost in costs.items():  # the shortest first
        if len(best.types) % len(layout.types) or layout == best:
            continue
        gain = cost - costs[best]
        if gain < _GAIN or (
            gain < _GAIN_OF_SCAN and _is_scan(_table(samples, layout), len(best.types) // len(layout.types))
        ):
            return layout
    return best


def _is_scan(table: NDArray[np.floating], repeats: int) -> bool:
    """Return True if most points lie in about the same direction, seen from above, as the ones before them.

    Normals may, too; they have the length 1.

    Args:
        table: rows [n, columns] that start with x, y, z.
        repeats: number of rows that make up one row of the other layout.
    """
    with np.errstate(all="ignore"):
        lengths = np.linalg.norm(table[:, :3].astype(np.float64), axis=1)
        if any(np.median(np.abs(lengths[i::repeats] - 1.0)) < 0.01 for i in range(repeats)):
            return False
        plane = table[:, :2].astype(np.float64)
        cosines = (plane[1:] * plane[:-1]).sum(axis=1)
        cosines /= np.linalg.norm(plane[1:], axis=1) * np.linalg.norm(plane[:-1], axis=1)
    cosines = cosines[np.isfinite(cosines)]
    return bool(len(cosines) and np.mean(cosines > _SAME_BEARING) >= _BEARINGS)
