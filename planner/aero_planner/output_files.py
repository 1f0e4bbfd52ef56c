"""Files that a command or a function writes: checked before the work, and replaced as a whole after it."""

from __future__ import annotations

import contextlib
import errno
import os
import stat
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

_found: dict[str, tuple[int, int, int] | None] = {}
"""Contents of the files that a command is going to replace, by their resolved names: what was there when it began."""


def check_output_files(
    *paths: Path | None, overwrite: bool, derived: Sequence[Path | None] = (), inputs: Sequence[str | Path] = ()
) -> None:
    """Check that files can be written before the work that makes them, which may take hours.

    Args:
        paths: files that a user has named; None is left out.
        overwrite: replace existing files.
        derived: further files, which are always replaced, since the same command makes them again: pictures, tables.
        inputs: what the command reads: files, which are never replaced, and other names, which are ignored.

    Raises:
        ValueError: a path is given twice, it is an input, it is a folder, its folder does not exist, permission to
            write it is missing, or it is a file of `paths` that is not empty and `overwrite` is False. A device or a
            pipe holds nothing that could be lost.
    """
    named = [path for path in (*paths, *derived) if path is not None]
    for i, path in enumerate(named):
        if path in named[:i]:
            raise ValueError(f"{path} cannot hold two outputs; choose another file for one of them.")
        if path.is_dir():
            raise ValueError(f"{path} is a folder; give the name of a file to write.")
        check_folder(path)
        if path.is_file() and any(os.path.exists(name) and path.samefile(name) for name in inputs):
            raise ValueError(f"{path} is read by this command and would be lost; choose another file to write.")
        if path not in derived and path.is_file() and path.stat().st_size > 0 and not overwrite:
            raise ValueError(f"{path} exists already; add --overwrite to replace it, or choose another file.")
        if path.exists() and not os.access(path, os.W_OK):
            raise ValueError(f"{path} cannot be written: permission denied. Choose another file.")
        if path not in derived:
            _found[os.path.realpath(path)] = _content(path)


def check_ending(path: Path | None, ending: str, content: str) -> None:
    """Check that the name of a file that is about to be written says what it holds; None, devices and pipes pass.

    Args:
        path: file that a user has named.
        ending: ending of the format, such as ".csv".
        content: what the file will hold, such as "a trajectory".

    Raises:
        ValueError: the name ends otherwise.
    """
    if path is None or (path.exists() and not path.is_file()) or path.suffix.lower() == ending:
        return
    raise ValueError(f"{path} is no name for {content}; choose one that ends in {ending}.")


def check_folder(path: Path) -> None:
    """Check that the folder of a file or folder that is about to be written exists and can be written to.

    Raises:
        ValueError: it does not, or it cannot.
    """
    folder = path.absolute().parent
    if not folder.is_dir():
        raise ValueError(f"There is no folder {path.parent}; create it first, or choose another place.")
    if not path.exists() and not os.access(folder, os.W_OK):
        raise ValueError(f"{path} cannot be written: its folder is read-only. Choose another folder.")


@contextlib.contextmanager
def whole_file(path: Path, *, alone: bool = False) -> Iterator[Path]:
    """Yield a file to write, which replaces `path` at the end unless something fails.

    A link stays, and what it leads to is replaced. A device or a pipe is yielded itself.

    Args:
        path: the file.
        alone: True refuses a file that another program is writing; otherwise the one that ends last replaces it.

    Raises:
        OSError: the file cannot be replaced, another program is writing it or has done so since `check_output_files`,
            or what the caller raises.
    """
    path = Path(os.path.realpath(path))
    if path.exists() and not path.is_file():
        yield path
        return
    writer = "" if alone else f"{os.getpid()}.{threading.get_native_id()}."
    partial = path.with_name(f".{path.stem}.{writer}partial{path.suffix}")
    lock = path.with_name(f".{path.name}.lock")  # not the partial file: who writes that may open it alone
    with open_alone(lock) if alone else contextlib.nullcontext():
        try:
            yield partial
            _refuse_new_content(path)
            os.replace(partial, path)
        finally:
            partial.unlink(missing_ok=True)
            if alone:
                lock.unlink(missing_ok=True)


def open_alone(path: str | os.PathLike[str], *, buffering: int = -1) -> BinaryIO:
    """Open a file to write, from its start, that no other program writes through this function.

    Raises:
        OSError: the file cannot be opened, or another program is writing it or has done so since `check_output_files`.
    """
    file = open(os.open(path, os.O_WRONLY | os.O_CREAT, 0o666), "wb", buffering=buffering)  # noqa: SIM115 (given to the caller)
    try:
        if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            _lock(file, path)
            _refuse_new_content(path)
            file.truncate(0)
        return file
    except BaseException:
        file.close()
        raise


def _content(path: str | os.PathLike[str]) -> tuple[int, int, int] | None:
    """Return what tells the content of a file from another one, None where there is none to lose."""
    try:
        status = os.stat(path)
    except FileNotFoundError:
        return None
    has_some = stat.S_ISREG(status.st_mode) and status.st_size > 0
    return (status.st_ino, status.st_size, status.st_mtime_ns) if has_some else None


def _refuse_new_content(path: str | os.PathLike[str]) -> None:
    """Raise OSError if a file has other content than `check_output_files` has found, which nobody agreed to lose."""
    name = os.path.realpath(path)
    present = _content(name)
    found = _found.pop(name, present)
    if present is not None and present != found:
        problem = "another program has written it since this one began; choose another file"
        raise OSError(errno.EEXIST, problem, str(path))


def _lock(file: BinaryIO, path: str | os.PathLike[str]) -> None:
    """Lock a file until it is closed, where the system can."""
    try:
        import fcntl
    except ImportError:  # Windows
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise OSError(errno.EBUSY, "another program is writing it; choose another file", str(path)) from error
    except OSError:  # a file system without locks
        pass
