"""A recording as a stream: its messages arrive when they were recorded, at real speed."""

from __future__ import annotations

import contextlib
import threading
from pathlib import Path

from aero_viz.errors import UserError
from aero_viz.live.stream import Stream
from aero_viz.recordings.choices import AUTOMATIC, Choices
from aero_viz.recordings.storage import open_storage, readable


class Player:
    """Feeds a stream from a file on a thread of its own, until the end of the file or `close`.

    Args:
        stream: takes the messages.
        path: a recording whose messages are those of ROS 2, or a capture of packets.
        choices: what is settled about the file.

    Raises:
        UserError: it cannot be read, or holds no message of ROS 2.
    """

    def __init__(self, stream: Stream, path: str | Path, choices: Choices = AUTOMATIC) -> None:
        self._stream, self._closed = stream, threading.Event()
        self._storage = open_storage(path, choices)
        with readable(self._storage.path):
            found = [(message, file) for file in self._storage.files for message in file.scan(())]
        self._messages = sorted(
            (entry for entry in found if entry[0].channel.encoding == "cdr"), key=lambda entry: entry[0].time
        )
        if not self._messages:
            self._storage.close()
            raise UserError(f"{path} holds no message of ROS 2 and no packets; play it with: aero-viz play {path}")
        self._thread = threading.Thread(target=self._run, name="aero-viz-player", daemon=True)
        self._thread.start()

    @property
    def is_over(self) -> bool:
        """True once the last message has been fed."""
        return not self._thread.is_alive()

    def _run(self) -> None:
        first, began = self._messages[0][0].time, self._stream.clock.now()
        for message, file in self._messages:
            due = began + message.time - first
            if self._closed.wait(max(due - self._stream.clock.now(), 0) * 1e-9):
                return
            with contextlib.suppress(ValueError):  # a damaged message is one that is lost
                self._stream.add(message.channel.topic, message.channel.type, file.read(message.position))

    def close(self) -> None:
        """Stop, and close the file."""
        self._closed.set()
        self._thread.join()
        self._storage.close()
