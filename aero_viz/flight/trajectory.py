"""Trajectory files: CSV with t,x,y,z,vx,vy,vz, one row per tick, SI units, world frame."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from aero_planner.output_files import open_alone
from aero_viz.errors import UserError

WriteRow = Callable[[float, ArrayLike, ArrayLike], None]


@contextlib.contextmanager
def trajectory_file(path: str | Path | None) -> Iterator[WriteRow]:
    """Give the context a function that appends a row: time [s], position [m], velocity [m/s]. For None it does nothing.

    Every row is written at once, so that a killed flight leaves a readable file.

    Raises:
        UserError: the file cannot be written.
    """
    if path is None:
        yield lambda time, position, velocity: None
        return
    with _errors_named(path):
        # Without a buffer: closing the file on a full disk has nothing left to write.
        file = open_alone(path, buffering=0)
    with file:

        def write(*cells: str) -> None:
            with _errors_named(path):
                file.write((",".join(cells) + "\r\n").encode())

        def write_row(time: float, position: ArrayLike, velocity: ArrayLike) -> None:
            write(*(f"{value:.6f}" for value in (time, *np.asarray(position), *np.asarray(velocity))))

        write("t", "x", "y", "z", "vx", "vy", "vz")
        yield write_row


@contextlib.contextmanager
def _errors_named(path: str | Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise UserError(f"Cannot write the trajectory {path}: {error.strerror or error}.") from error
