"""The check of files that a command or a function is about to write."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from aero_viz.errors import UserError


def check_output_files(*paths: Path | None, overwrite: bool, derived: Sequence[Path | None] = ()) -> None:
    """Check that files can be written before the work that makes them, which may take hours.

    Args:
        paths: files that a user has named; None is left out.
        overwrite: replace existing files.
        derived: further ones that are replaced in any case, since the same command makes them again: pictures, tables.

    Raises:
        UserError: a path is given twice, it is a folder, its folder does not exist, or it is a file of `paths` that is
            not empty and `overwrite` is False. A device or a pipe holds nothing that could be lost.
    """
    named = [path for path in (*paths, *derived) if path is not None]
    for i, path in enumerate(named):
        if path in named[:i]:
            raise UserError(f"{path} cannot hold two outputs; choose another file for one of them.")
        if path.is_dir():
            raise UserError(f"{path} is a folder; give the name of a file to write.")
        if not path.absolute().parent.is_dir():
            raise UserError(f"There is no folder {path.parent}; create it first, or choose another file.")
        if path not in derived and path.is_file() and path.stat().st_size > 0 and not overwrite:
            raise UserError(f"{path} exists already; add --overwrite to replace it, or choose another file.")
