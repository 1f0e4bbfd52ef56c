"""Opening of files that a user names. They may be pipes, devices or sockets, which block or never end."""

from __future__ import annotations

import errno
import os
import stat
from typing import BinaryIO


def open_user_file(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a regular file for reading; anything else is refused at once, without a byte being read.

    Raises:
        OSError: there is no such file, it may not be read, or it is not a regular file; `strerror` says which.
    """
    # Opening a device can have side effects, so the kind is checked first, and again once the file is open.
    _check_kind(os.stat(path).st_mode, path)
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    try:
        _check_kind(os.fstat(descriptor).st_mode, path)
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_user_text(path: str | os.PathLike[str], *, limit: int) -> str:
    """Return the UTF-8 text of a regular file of at most `limit` bytes, without a byte order mark.

    Raises:
        OSError: the file cannot be read or is larger; `strerror` says which.
        UnicodeDecodeError: it is not UTF-8.
    """
    with open_user_file(path) as file:
        content = file.read(limit + 1)
    if len(content) > limit:
        raise OSError(errno.EFBIG, f"it is larger than {limit >> 20} MiB", str(path))
    return content.decode("utf-8-sig")


def _check_kind(mode: int, path: str | os.PathLike[str]) -> None:
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, "Is a directory", str(path))
    if not stat.S_ISREG(mode):
        kinds = {stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket", stat.S_IFCHR: "a device", stat.S_IFBLK: "a device"}
        kind = kinds.get(stat.S_IFMT(mode), "a special file")
        raise OSError(errno.EINVAL, f"it is {kind}, not a regular file", str(path))
