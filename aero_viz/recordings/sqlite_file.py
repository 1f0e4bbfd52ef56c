"""rosbag2's SQLite files (.db3)."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Iterator
from pathlib import Path

from aero_viz.input_limits import LimitExceeded, ReadingBudget
from aero_viz.plain_sqlite import connect_read_only, limit_time
from aero_viz.recordings.bag_file import (
    HEAD_BYTES,
    ZSTD_MAGIC,
    BagFile,
    Channel,
    Message,
    make_channel,
    one_line,
    unwrap,
)

SQLITE_MAGIC = b"SQLite format 3\0"

_COLUMNS = {
    "topics": {"id", "name", "type", "serialization_format"},
    "messages": {"id", "topic_id", "timestamp", "data"},
}


class SqliteFile(BagFile):
    """One SQLite file of rosbag2. A position is a row number. Heads are read without loading their messages.

    The schema of a database is a program: views, virtual tables and generated columns can make a query endless. Only
    plain tables are read, and every query has a budget of time.
    """

    def __init__(self, path: Path):
        super().__init__(path)
        # A session may play in another thread than the one that opened the file, but never in two at once.
        self._database = connect_read_only(path)
        self._start_budget()

    def _start_budget(self) -> ReadingBudget:
        """Give the following queries the time that the size of the file allows."""
        return limit_time(self._database, self.path, self.budget_share)

    def scan(self, types: Collection[str]) -> Iterator[Message]:
        budget = self._start_budget()
        try:
            self._check_tables()
            for row, topic, type_name, encoding in self._database.execute(
                "SELECT id, name, type, serialization_format FROM topics ORDER BY id"
            ):
                self.channels[row] = make_channel(str(topic), str(type_name), str(encoding))
            # Reading the table in row order skips the pages of the messages and survives a damaged index.
            rows = self._database.execute("SELECT id, topic_id, timestamp FROM messages ORDER BY id")
            for number, (row, topic, time) in enumerate(rows):
                if number % 128 == 0:
                    budget.check_time()
                if topic in self.channels and isinstance(time, int):
                    yield self._message(row, self.channels[topic], time, types, budget)
                else:
                    self.damaged += 1
        except LimitExceeded as error:
            self.problems.append(str(error))
        except (sqlite3.Error, ValueError) as error:
            self.problems.append(f"damaged or truncated ({one_line(error)}); only the data before the damage is used")

    def _check_tables(self) -> None:
        """Raise ValueError unless the two tables of rosbag2 are plain tables."""
        for table, columns in _COLUMNS.items():
            kinds = self._database.execute(
                "SELECT type, rootpage FROM sqlite_master WHERE name = ? COLLATE NOCASE", (table,)
            ).fetchmany(2)
            # Views and virtual tables have no pages.
            if len(kinds) != 1 or kinds[0][0] != "table" or not kinds[0][1]:
                raise ValueError(f"it has no plain table {table!r}, as rosbag2 writes it")
            plain = {row[1] for row in self._database.execute(f"PRAGMA table_xinfo({table})") if row[6] == 0}
            if not columns <= plain:
                raise ValueError(f"its table {table!r} lacks the plain column {min(columns - plain)!r}")

    def _message(self, row: int, channel: Channel, time: int, types: Collection[str], budget: ReadingBudget) -> Message:
        if channel.type not in types:
            return Message(channel, time, row, 0, b"")
        try:
            with self._database.blobopen("messages", "data", row, readonly=True) as blob:
                size, head = len(blob), blob.read(HEAD_BYTES)
            if not head.startswith(ZSTD_MAGIC):
                return Message(channel, time, row, size, head)
            whole = self._read(row)
        except Exception:
            return Message(channel, time, row, 0, b"")
        budget.take_bytes(len(whole))
        return Message(channel, time, row, len(whole), whole[:HEAD_BYTES])

    def read(self, position: int) -> bytes:
        self._start_budget()
        return self._read(position)

    def _read(self, position: int) -> bytes:
        try:
            (data,) = self._database.execute("SELECT data FROM messages WHERE id = ?", (position,)).fetchone()
            return unwrap(bytes(data))
        except (sqlite3.Error, TypeError) as error:
            raise ValueError(f"row {position} is damaged ({error})") from error

    def close(self) -> None:
        self._database.close()
