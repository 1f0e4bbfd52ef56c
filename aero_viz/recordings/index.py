"""The contents of a recording, found by one process and used by another."""

from __future__ import annotations

import io
import pickle
from pathlib import Path
from typing import Any

from aero_viz.answers import Unpickler
from aero_viz.recordings.bag_file import BagFile
from aero_viz.recordings.contents import Contents, read_contents
from aero_viz.recordings.opening import configure_recording
from aero_viz.recordings.recording import Recording
from aero_viz.recordings.storage import Storage, open_storage, readable


def index_recording(path: str | Path) -> bytes:
    """Return the results of the pass over all messages of a recording, for `open_indexed`.

    Raises:
        UserError: the recording cannot be played.
    """
    storage = open_storage(path)
    try:
        with readable(storage.path):
            buffer = io.BytesIO()
            _Pickler(buffer, storage).dump(read_contents(storage))
            return buffer.getvalue()
    finally:
        storage.close()


def open_indexed(
    path: str | Path, index: bytes, *, points_topic: str | None = None, pose_topic: str | None = None
) -> Recording:
    """Open a recording as `open_recording` does, without the pass over its messages.

    Args:
        path: file or folder.
        index: result of `index_recording` for it.
        points_topic, pose_topic: see `open_recording`.

    Raises:
        UserError: the recording cannot be played.
    """
    storage = open_storage(path)
    try:
        with readable(storage.path):
            contents: Contents = _Unpickler(io.BytesIO(index), storage).load()
            recording = Recording(storage, contents, points_topic, pose_topic)
            configure_recording(recording, storage, contents)
            return recording
    except BaseException:
        storage.close()
        raise


class _Pickler(pickle.Pickler):
    """Stores an open file as its number in the recording."""

    def __init__(self, buffer: io.BytesIO, storage: Storage) -> None:
        super().__init__(buffer, protocol=pickle.HIGHEST_PROTOCOL)
        self._storage = storage

    def persistent_id(self, obj: Any) -> int | None:
        return self._storage.files.index(obj) if isinstance(obj, BagFile) else None


class _Unpickler(Unpickler):
    def __init__(self, buffer: io.BytesIO, storage: Storage) -> None:
        super().__init__(buffer)
        self._storage = storage

    def persistent_load(self, pid: Any) -> BagFile:
        return self._storage.files[pid]
