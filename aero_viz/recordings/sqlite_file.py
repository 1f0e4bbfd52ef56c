"""rosbag2's SQLite files (.db3)."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Iterator
from pathlib import Path
from urllib.parse import quote

from aero_viz.recordings.bag_file import HEAD_BYTES, ZSTD_MAGIC, BagFile, Channel, Message, make_channel, unwrap

__all__ = ["SQLITE_MAGIC", "SqliteFile"]

SQLITE_MAGIC = b"SQLite format 3\0"


class SqliteFile(BagFile):
    """One SQLite file of rosbag2. A position is a row number. Heads are read without loading their messages."""

    def __init__(self, path: Path):
        super().__init__(path)
        # Without a write-ahead log nobody is writing; `immutable` then allows a read-only folder.
        log = path.with_name(path.name + "-wal")
        mode = "mode=ro" if log.exists() and log.stat().st_size else "mode=ro&immutable=1"
        # A session may play in another thread than the one that opened the file, but never in two at once.
        self._database = sqlite3.connect(f"file:{quote(str(path.resolve()))}?{mode}", uri=True, check_same_thread=False)

    def scan(self, types: Collection[str]) -> Iterator[Message]:
        try:
            for row, topic, type_name, encoding in self._database.execute(
                "SELECT id, name, type, serialization_format FROM topics ORDER BY id"
            ):
                self.channels[row] = make_channel(str(topic), str(type_name), str(encoding))
            # Reading the table in row order skips the pages of the messages and survives a damaged index.
            rows = self._database.execute("SELECT id, topic_id, timestamp FROM messages ORDER BY id")
            for row, topic, time in rows:
                if topic in self.channels and isinstance(time, int):
                    yield self._message(row, self.channels[topic], time, types)
                else:
                    self.damaged += 1
        except (sqlite3.Error, ValueError) as error:
            self.problems.append(f"damaged or truncated ({error}); only what precedes the damage is used")

    def _message(self, row: int, channel: Channel, time: int, types: Collection[str]) -> Message:
        if channel.type not in types:
            return Message(channel, time, row, 0, b"")
        try:
            with self._database.blobopen("messages", "data", row, readonly=True) as blob:
                size, head = len(blob), blob.read(HEAD_BYTES)
            if not head.startswith(ZSTD_MAGIC):
                return Message(channel, time, row, size, head)
            whole = self.read(row)
            return Message(channel, time, row, len(whole), whole[:HEAD_BYTES])
        except Exception:
            return Message(channel, time, row, 0, b"")

    def read(self, position: int) -> bytes:
        try:
            (data,) = self._database.execute("SELECT data FROM messages WHERE id = ?", (position,)).fetchone()
            return unwrap(bytes(data))
        except (sqlite3.Error, TypeError) as error:
            raise ValueError(f"row {position} is damaged ({error})") from error

    def close(self) -> None:
        self._database.close()
