"""Opening of files that a user names, the one place for it.

They may be pipes, devices or sockets, which block or never end, and links may lead anywhere.
"""

from __future__ import annotations

import errno
import json
import os
import stat
from collections.abc import Callable, Iterable
from typing import Any, BinaryIO

_DIGITS_MAX = 4000
"""More digits than any number in a file has; Python refuses 4300 in words of its own."""
_folders: tuple[str, ...] | None = None


class NotTextError(UnicodeDecodeError):
    """A file is not UTF-8; its text completes the sentence "FILE is ..."."""

    def __str__(self) -> str:
        return f"not UTF-8 text (byte {self.start})"


def restrict_user_files(folders: Iterable[str | os.PathLike[str]] | None) -> None:
    """Let `open_user_file` open only what lies in these folders, after all links are resolved; None lifts this.

    It holds for this process and for the readers that it starts.
    """
    global _folders
    _folders = None if folders is None else tuple(os.path.realpath(folder) for folder in folders)


def user_folders() -> tuple[str, ...] | None:
    """Return the folders of `restrict_user_files`, None without a restriction."""
    return _folders


def open_user_file(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a regular file for reading; anything else is refused at once, without a byte being read.

    Raises:
        OSError: there is no such file, it may not be read, it lies outside the folders of `restrict_user_files`, or it
            is not a regular file; `strerror` says which.
    """
    resolved = os.path.realpath(path)
    if _folders is not None and not any(os.path.commonpath([resolved, folder]) == folder for folder in _folders):
        raise FileNotFoundError(errno.ENOENT, "No such file in the folders that may be read", str(path))
    # Opening a device can have side effects, so the kind is checked first, and again once the file is open. What was
    # resolved is no link any more; if it has become one since, it is refused.
    _check_kind(os.stat(resolved).st_mode, path)
    flags = os.O_RDONLY | sum(getattr(os, name, 0) for name in ("O_NONBLOCK", "O_BINARY", "O_NOFOLLOW", "O_CLOEXEC"))
    try:
        descriptor = os.open(resolved, flags)
    except OSError as error:
        raise type(error)(error.errno, error.strerror, str(path)) from None
    try:
        _check_kind(os.fstat(descriptor).st_mode, path)
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def open_companion(path: str | os.PathLike[str], name: str) -> BinaryIO:
    """Open a file that the content of another one names; it must lie in the same folder or below it.

    Args:
        path: the file that names it.
        name: its path, relative to the folder of `path`.

    Raises:
        OSError: it is absolute, or lies elsewhere after all links are resolved; else as for `open_user_file`.
    """
    folder = os.path.dirname(os.path.abspath(path))
    target = os.path.join(folder, name)
    is_below = not os.path.isabs(name) and "\0" not in name
    # The file itself may be a link: what lies beside the link or beside its target belongs to it.
    homes = {os.path.realpath(folder), os.path.dirname(os.path.realpath(path))}
    if not is_below or not any(os.path.commonpath([os.path.realpath(target), home]) == home for home in homes):
        problem = f"it names {name[:60]!r}, and only files of its own folder are opened"
        raise PermissionError(errno.EACCES, problem, str(path))
    try:
        return open_user_file(target)
    except OSError as error:
        raise type(error)(error.errno, f"it names {name[:60]!r}: {error.strerror}", str(path)) from error


def read_user_bytes(path: str | os.PathLike[str], *, limit: int | None = None) -> bytes:
    """Return the content of a regular file, of at most `limit` bytes if that is given.

    Raises:
        OSError: the file cannot be read or is larger; `strerror` says which.
    """
    with open_user_file(path) as file:
        content = file.read(-1 if limit is None else limit + 1)
    if limit is not None and len(content) > limit:
        size = f"{limit >> 20} MiB" if limit >> 20 else f"{limit >> 10} KiB"
        raise OSError(errno.EFBIG, f"it is larger than {size}", str(path))
    return content


def read_user_text(path: str | os.PathLike[str], *, limit: int) -> str:
    """Return the UTF-8 text of a regular file of at most `limit` bytes, without a byte order mark.

    Raises:
        OSError: the file cannot be read or is larger; `strerror` says which.
        NotTextError: it is not UTF-8.
    """
    try:
        return read_user_bytes(path, limit=limit).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise NotTextError(*error.args) from None


def parse_json(text: str | bytes, make_object: Callable[[list[tuple[str, Any]]], Any] | None = None) -> Any:
    """Return the value of a JSON text that a stranger may have written.

    Args:
        text: the text, in UTF-8 if it is bytes.
        make_object: makes an object of its keys and values; None makes a dict.

    Raises:
        ValueError: it is not JSON, is nested too deeply, or has an integer of more than 4000 digits.
    """
    try:
        return json.loads(text, object_pairs_hook=make_object, parse_int=_integer)
    except json.JSONDecodeError as error:
        raise ValueError(f"it is not JSON: {error.msg} in line {error.lineno}, column {error.colno}") from error
    except UnicodeDecodeError as error:
        raise ValueError("it is not JSON: it is not UTF-8 text") from error
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def _integer(digits: str) -> int:
    if len(digits) > _DIGITS_MAX:
        raise ValueError(f"it has a number of {len(digits)} digits, and at most {_DIGITS_MAX} are read")
    return int(digits)


def _check_kind(mode: int, path: str | os.PathLike[str]) -> None:
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, "Is a directory", str(path))
    if not stat.S_ISREG(mode):
        kinds = {stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket", stat.S_IFCHR: "a device", stat.S_IFBLK: "a device"}
        kind = kinds.get(stat.S_IFMT(mode), "a special file")
        raise OSError(errno.EINVAL, f"it is {kind}, not a regular file", str(path))
