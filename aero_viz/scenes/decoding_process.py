"""The process that decodes the files of maps and clouds, with limits on its memory and time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from aero_planner.plain_text import has_own_words, one_line
from aero_viz.errors import UserError
from aero_viz.reader_process import Limits, ReaderProcess
from aero_viz.scenes.las import LasUnits
from aero_viz.scenes.solids import Solids

T = TypeVar("T")


class DecodingProcess:
    """Decodes files one after the other in one process, started by the first of them; each file has its own limits."""

    def __init__(self) -> None:
        self._process = ReaderProcess(is_kept=True)

    def decode(self, path: Path, content: str) -> NDArray[np.float64]:
        """Return the result of `aero_viz.scenes.map_decoders.decode`.

        Raises:
            OSError: there is no such file.
            ValueError: the file cannot be decoded within the limits; the text says why.
        """
        return self._run(path, _decode, content)

    def decode_points(self, path: Path, suffix: str | None = None) -> tuple[NDArray[np.float64], NDArray[Any] | None]:
        """Return the result of `aero_viz.scenes.map_decoders.decode_points`.

        Raises:
            OSError, ValueError: as for `decode`.
        """
        return self._run(path, _decode_points, suffix)

    def las_units(self, path: Path) -> LasUnits:
        """Return the units of a LAS or LAZ file.

        Raises:
            OSError, ValueError: as for `decode`.
        """
        return self._run(path, _las_units)

    def solids(self, path: Path, pixel: float | None) -> Solids:
        """Return the solids of a Gazebo world or of an occupancy image with pixels of this edge [m].

        Raises:
            OSError, ValueError: as for `decode`.
        """
        return self._run(path, _solids, pixel)

    def _run(self, path: Path, function: Callable[..., T], *arguments: Any) -> T:
        try:
            return self._process.call(Limits.for_file(path.stat().st_size), function, path, *arguments)
        except UserError as error:
            text = str(error)
            raise ValueError(text[:1].lower() + text[1:]) from error

    def close(self) -> None:
        """End the process."""
        self._process.close()

    def __enter__(self) -> DecodingProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _decode(path: Path, content: str) -> NDArray[np.float64]:
    from aero_viz.scenes.map_decoders import decode

    with _one_sentence():
        return np.ascontiguousarray(decode(path, content), dtype=np.float64)


def _decode_points(path: Path, suffix: str | None) -> tuple[NDArray[np.float64], NDArray[Any] | None]:
    from aero_viz.scenes.map_decoders import decode_points

    with _one_sentence():
        return decode_points(path, suffix)


def _las_units(path: Path) -> LasUnits:
    from aero_viz.scenes.las import read_las_units

    with _one_sentence():
        return read_las_units(path)


def _solids(path: Path, pixel: float | None) -> Solids:
    from aero_viz.scenes.gazebo import read_gazebo
    from aero_viz.scenes.occupancy import read_occupancy

    with _one_sentence():
        return read_gazebo(path) if path.suffix.lower() in (".world", ".sdf") else read_occupancy(path, pixel)


@contextmanager
def _one_sentence() -> Iterator[None]:
    """Turn any error of a parser that reads a damaged file into a UserError."""
    try:
        yield
    except MemoryError:
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.strerror:  # libraries derive errors of their own, which have none
            raise UserError(error.strerror) from error
        if type(error) is ValueError and has_own_words(error):
            raise UserError(one_line(error)[:300]) from error
        raise UserError("its data are damaged, or are not what its name says") from error
