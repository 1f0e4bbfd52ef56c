"""The contents of a recording, found by one process and used by another."""

from __future__ import annotations

from pathlib import Path

from aero_viz.answers import decode, encode
from aero_viz.recordings.contents import Contents, read_contents
from aero_viz.recordings.opening import configure_recording
from aero_viz.recordings.recording import Recording
from aero_viz.recordings.storage import open_storage, readable


def index_recording(path: str | Path) -> bytes:
    """Return the results of the pass over all messages of a recording, for `open_indexed`.

    Raises:
        UserError: the recording cannot be played.
    """
    storage = open_storage(path)
    try:
        with readable(storage.path):
            return encode(read_contents(storage), storage.files)
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
            contents: Contents = decode(index, storage.files)
            recording = Recording(storage, contents, points_topic, pose_topic)
            configure_recording(recording, storage, contents)
            return recording
    except BaseException:
        storage.close()
        raise
