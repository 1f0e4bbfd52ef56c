"""Keeps on disk which signed messages were accepted, so that none of them is accepted again after a restart."""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TypeAlias

from aero_planner.mailbox import Mailbox
from aero_planner.output_files import whole_file
from aero_planner.user_file import read_user_text

Stream: TypeAlias = tuple[int, int, int]
"""Link id of the signature, system id and component id of the sender."""

_AHEAD = 200_000
"""By how much the time stamps on disk are ahead while messages arrive [10 us]: longer than between two writes."""
_SIZE_MAX = 1 << 20  # [bytes]
_log = logging.getLogger(__name__)


def state_folder() -> Path:
    """Return the folder in which the node keeps what outlasts it, as systemd or the XDG specification names it."""
    given = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    if given:
        return Path(given)
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "aero-planner"


class SigningMemory:
    """The newest time stamp of each stream of signed messages, in a file that is written on a thread of its own.

    Args:
        key: The secret key; each has a file.
        folder: Folder of the file, which is made if it is missing; None takes `state_folder`.

    Raises:
        ValueError: The file is damaged, or can't be written; says what to do.
    """

    def __init__(self, key: bytes, folder: Path | None = None) -> None:
        folder = state_folder() if folder is None else folder
        self._path = folder / f"signing_{hashlib.sha256(b'memory' + key).hexdigest()[:16]}"
        self._has_failed = False
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            self.streams: Mapping[Stream, int] = self._read() if self._path.exists() else {}
            """Newest time stamp of each stream when the memory was opened [10 us since 2015]."""
            self._write(self.streams)
        except OSError as error:
            raise ValueError(
                f"can't keep the time stamps of signed messages in {folder}: {error.strerror or error}; set "
                "XDG_STATE_HOME to a folder that this user may write to."
            ) from error
        self._kept: dict[Stream, int] = {}
        """Time stamps that are on disk, or soon will be."""
        self._mailbox: Mailbox[Mapping[Stream, int]] = Mailbox(
            self._save, name="aero-planner-signing", low_priority=True
        )

    def keep(self, streams: Mapping[Stream, int], changed: Stream) -> None:
        """Write the time stamps soon, unless that of the changed stream on disk is far enough ahead. Never blocks."""
        if streams[changed] > self._kept.get(changed, 0) - _AHEAD // 2:
            self._kept = {stream: stamp + _AHEAD for stream, stamp in streams.items()}
            self._mailbox.put(self._kept)

    def close(self, streams: Mapping[Stream, int]) -> None:
        """Write the time stamps as they are."""
        self._mailbox.put(dict(streams))
        self._mailbox.finish()

    def _read(self) -> dict[Stream, int]:
        try:
            lines = read_user_text(self._path, limit=_SIZE_MAX).splitlines()
            rows = [[int(word) for word in line.split()] for line in lines]
            return {(link, system, component): stamp for link, system, component, stamp in rows}
        except ValueError as error:
            raise ValueError(
                f"{self._path}, with the time stamps of signed messages, is damaged: delete it once the date is right."
            ) from error

    def _save(self, streams: Mapping[Stream, int]) -> None:
        try:
            self._write(streams)
            self._has_failed = False
        except OSError as error:
            if not self._has_failed:
                _log.error(
                    "the time stamps of signed messages can't be kept in %s: %s; after a restart, old messages could "
                    "be accepted again", self._path, error.strerror or error,
                )  # fmt: skip
            self._has_failed = True

    def _write(self, streams: Mapping[Stream, int]) -> None:
        lines = (f"{link} {system} {component} {stamp}\n" for (link, system, component), stamp in streams.items())
        with whole_file(self._path) as partial, partial.open("w", encoding="ascii") as file:
            file.writelines(lines)
            file.flush()
            os.fsync(file.fileno())
