"""Location of a flight log: a path that ends in .mcap is a file, and any other one is a folder."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

_SUFFIX = ".mcap"
_ADVICE = "create a folder that this user may write to, or name another place with --log."


def check_log_place(log: str | os.PathLike[str]) -> Path:
    """Return the folder in which a flight log can be written, or would be created, and which exists; creates nothing.

    Raises:
        OSError: no log can be written there; says what to do.
    """
    path = Path(log)
    folder = path.absolute() if _is_folder(path) else path.absolute().parent
    try:
        if _is_folder(path):
            while not os.path.exists(folder):
                folder = folder.parent
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError as error:
        raise unwritable(path, error) from error


def make_log_path(log: str | os.PathLike[str]) -> Path:
    """Return the path of a new flight log. A folder is created if it does not exist; the file's name is the date.

    Raises:
        OSError: the folder can't be created; says what to do.
    """
    path = Path(log)
    if not _is_folder(path):
        return path
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritable(path, error) from error
    return path / time.strftime(f"flight_%Y%m%d_%H%M%S{_SUFFIX}")


def unwritable(path: Path, error: OSError) -> OSError:
    """Return the error for a flight log that can't be written to a file or folder, with what to do."""
    if os.path.isfile(path) and _is_folder(path):
        return OSError(
            f"the flight log can't be written to {path}, which is a file: name a folder, or a file that ends in "
            f"{_SUFFIX}, with --log."
        )
    return OSError(f"the flight log {path} can't be written: {error.strerror or error}; {_ADVICE}")


def _is_folder(path: Path) -> bool:
    return path.suffix.lower() != _SUFFIX or os.path.isdir(path)
