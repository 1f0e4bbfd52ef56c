"""Trajectory files: CSV with t,x,y,z,vx,vy,vz, one row per tick, SI units, world frame."""

from __future__ import annotations

import contextlib
import csv
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from aero_viz.errors import UserError

__all__ = ["trajectory_file"]

WriteRow = Callable[[float, ArrayLike, ArrayLike], None]


@contextlib.contextmanager
def trajectory_file(path: str | Path | None) -> Iterator[WriteRow]:
    """Give the context a function that appends a row: time [s], position [m], velocity [m/s]. For None it does nothing.

    Every row is flushed, so that a killed flight leaves a readable file.

    Raises:
        UserError: the file cannot be written.
    """
    if path is None:
        yield lambda time, position, velocity: None
        return
    try:
        file = open(path, "w", newline="", encoding="utf-8")  # noqa: SIM115 (closed below; opening has its own error)
    except OSError as error:
        raise _failed(path, error) from error
    with file:
        writer = csv.writer(file)

        def write(*values: object) -> None:
            try:
                writer.writerow(values)
                file.flush()
            except OSError as error:
                raise _failed(path, error) from error

        def write_row(time: float, position: ArrayLike, velocity: ArrayLike) -> None:
            write(*(f"{value:.6f}" for value in (time, *np.asarray(position), *np.asarray(velocity))))

        write("t", "x", "y", "z", "vx", "vy", "vz")
        yield write_row


def _failed(path: str | Path, error: OSError) -> UserError:
    return UserError(f"Cannot write the trajectory {path}: {error.strerror or error}.")
