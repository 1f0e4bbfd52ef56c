"""The bytes of a file by position, read with the file's own calls and never mapped into memory."""

from __future__ import annotations

import os
from pathlib import Path

from aero_planner.user_file import open_user_file

_WINDOW = 16_384
"""Bytes that are read at once for a short slice: the header of a record and the head of its message."""


class FileBytes:
    """A file that is sliced like `bytes`.

    A mapped file that shrinks while it plays ends the process with SIGBUS; here only the slices become shorter.

    Args:
        path: a regular file.

    Raises:
        OSError: it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self._file = open_user_file(path)
        self._size = os.fstat(self._file.fileno()).st_size
        self._window, self._start = b"", 0

    def __len__(self) -> int:
        """Return the size of the file when it was opened [bytes]."""
        return self._size

    def __getitem__(self, part: slice) -> bytes:
        """Return the bytes of a slice without a step, fewer where the file has shrunk.

        Neighbouring short slices share one call. `fresh` is for content that may have changed since.
        """
        start, stop, _ = part.indices(self._size)
        first = start - self._start
        if first >= 0 and stop - self._start <= len(self._window):
            return self._window[first : stop - self._start]
        if stop - start > _WINDOW // 2:
            return self.fresh(start, stop)
        self._window, self._start = self.fresh(start, min(start + _WINDOW, self._size)), start
        return self._window[: max(stop - start, 0)]

    def fresh(self, start: int, stop: int) -> bytes:
        """Return the bytes from `start` to `stop` as they are in the file now."""
        parts, at = [], start
        while at < stop:
            part = os.pread(self._file.fileno(), stop - at, at)
            if not part:
                break
            parts.append(part)
            at += len(part)
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def prefetch(self, start: int, stop: int) -> None:
        """Let the system read the bytes from `start` to `stop` in the background, where it can (Linux)."""
        if hasattr(os, "posix_fadvise") and stop > start:
            os.posix_fadvise(self._file.fileno(), start, stop - start, os.POSIX_FADV_WILLNEED)

    def close(self) -> None:
        """Close the file."""
        self._file.close()
