"""Checks that the decoders of maps share."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any
from xml.parsers.expat import XMLParserType

import numpy as np
from numpy.typing import NDArray

from aero_planner.user_file import open_user_file
from aero_viz.errors import UserError
from aero_viz.input_limits import COORDINATE_MAX, MAP_POINTS_MAX

_POINTERS = (
    b"version https://git-lfs.github.com/spec/",
    b"/annex/objects/",
    b"version https://hawser.github.com/spec/",
)
"""Starts of what Git LFS and git-annex put in place of a file."""
_POINTER_MAX = 1024  # [bytes]
_HEADER_MAX = 65_536  # [bytes] that are searched for the end of a header


def refuse_pointer(path: Path) -> None:
    """Refuse what is left of a file in a checkout without the content of large files.

    Raises:
        UserError: it is a pointer of Git LFS or git-annex.
        OSError: it cannot be read.
    """
    if path.stat().st_size > _POINTER_MAX:
        return
    with open_user_file(path) as file:
        start = file.read(64)
    if start.startswith(_POINTERS):
        tool = "git annex get" if start.startswith(_POINTERS[1]) else "git lfs pull"
        raise UserError(
            f"{path} is not the file itself but a pointer to it, as Git keeps large files: fetch it with `{tool}` in "
            "its repository, or download it."
        )


def check_count(declared: int, present: int, noun: str = "points") -> None:
    """Raise ValueError unless a file holds what its header declares, and no more than a map may have."""
    if not 0 <= declared <= present:
        raise ValueError(f"it is truncated: its header declares {declared} {noun}, and it holds {present}")
    if declared > MAP_POINTS_MAX:
        raise ValueError(f"it has {declared} {noun}, and at most {MAP_POINTS_MAX} can be used: thin it out")


def check_place(centre: NDArray[np.float64], path: str | Path) -> None:
    """Raise UserError unless the centre [m] of what a file holds is where coordinates are still exact."""
    axis = int(np.argmax(np.abs(centre)))
    if not abs(centre[axis]) <= COORDINATE_MAX:
        raise UserError(
            f"{path} lies at {'xyz'[axis]} = {centre[axis]:.3g} m, and coordinates of at most {COORDINATE_MAX:g} m are "
            "exact: move it to its origin."
        )


def load_rows(lines: Iterable[bytes] | Iterable[str], columns: Sequence[int], **options: Any) -> NDArray[np.float64]:
    """Return the columns of numbers in a text [n, columns], with further options of `np.loadtxt`.

    Raises:
        ValueError: a row has too few columns, or something else than numbers.
    """
    try:
        return np.loadtxt(lines, usecols=columns, ndmin=2, **options)
    except ValueError as error:
        row = re.search(r"row (\d+)", str(error))
        where = f"row {row[1]}" if row else "a row"
        raise ValueError(f"it is damaged or truncated: {where} does not have {len(columns)} numbers there") from error


def read_header(path: Path, pattern: bytes, problem: str) -> tuple[bytes, int]:
    """Return the header of a file and the number of bytes after it; raises ValueError(problem) if there is none."""
    with open_user_file(path) as file:
        found = re.match(pattern, file.read(_HEADER_MAX))
    if found is None:
        raise ValueError(problem)
    return found.group(), path.stat().st_size - found.end()


def read_ply_header(path: Path) -> tuple[bytes, dict[bytes, int]]:
    """Return the header of a PLY file and its elements with their counts; raises ValueError without one."""
    header, _ = read_header(path, rb"(?s)^ply\s.*?\nend_header[ \t]*\r?\n", "it does not start with a PLY header")
    return header, {name: int(n) for name, n in re.findall(rb"\nelement[ \t]+(\w+)[ \t]+(\d+)", header)}


def refuse_entities(parser: XMLParserType) -> None:
    """Make a parser of XML raise ValueError for a document type or an entity.

    These expand to gigabytes, or name files and servers, from which other parsers would read.
    """

    def refuse(*_: object) -> None:
        raise ValueError("it has a document type or defines entities, which nobody needs here; remove the definition")

    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = refuse
