"""SQLite databases of strangers, of which only plain tables are read, each query with a budget of time.

The schema of a database is a program: views, triggers, virtual tables and generated columns can make a query endless.
"""

from __future__ import annotations

import sqlite3
from pathlib import Path
from urllib.parse import quote

from aero_planner.user_file import open_user_file
from aero_viz.input_limits import BLOCK_MAX, ReadingBudget

_STEPS = 10_000
"""Instructions of SQLite's virtual machine between two checks of the clock."""


def connect_read_only(path: Path, *, is_written: bool = False) -> sqlite3.Connection:
    """Return a connection that cannot change the file, and may be used by several threads in turn.

    Args:
        path: the file.
        is_written: another process may be writing it.

    Raises:
        OSError: it is no regular file, or cannot be read; `strerror` says why.
        sqlite3.Error: it is no database.
    """
    open_user_file(path).close()
    # Without a write-ahead log nobody is writing; `immutable` then allows a read-only folder.
    log = path.with_name(path.name + "-wal")
    mode = "mode=ro" if is_written or (log.exists() and log.stat().st_size) else "mode=ro&immutable=1"
    database = sqlite3.connect(f"file:{quote(str(path.resolve()))}?{mode}", uri=True, check_same_thread=False)
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, BLOCK_MAX)
    for pragma in ("trusted_schema = OFF", "cell_size_check = ON", "mmap_size = 0", "temp_store = MEMORY"):
        database.execute(f"PRAGMA {pragma}")
    return database


def limit_time(database: sqlite3.Connection, path: Path, share: float = 1.0) -> ReadingBudget:
    """Give the following queries the time that the size of the file allows, and return that budget.

    A query that takes longer raises sqlite3.OperationalError.
    """
    budget = ReadingBudget(path.stat().st_size, share)
    database.set_progress_handler(lambda: budget.is_late, _STEPS)
    return budget


def check_schema(database: sqlite3.Connection) -> None:
    """Check that a database has nothing but plain tables and their plain indexes.

    Raises:
        ValueError: it has something else; the text completes the sentence "FILE ..".
        sqlite3.Error: it is damaged.
    """
    for kind, name, page in database.execute("SELECT type, name, rootpage FROM sqlite_master").fetchall():
        # Views, triggers and virtual tables have no pages.
        if kind not in ("table", "index") or not page:
            raise ValueError(f"has the {kind} {_short(name)}, and only plain tables are read")
        # The number of a column of an index that is an expression is -2; generated columns are hidden.
        query, column = ("table_xinfo", 6) if kind == "table" else ("index_xinfo", 1)
        rows = database.execute(f"SELECT * FROM pragma_{query}(?)", (name,)).fetchall()
        if any(row[column] > 0 if kind == "table" else row[column] == -2 for row in rows):
            raise ValueError(f"has computed columns in its {kind} {_short(name)}, and only plain tables are read")


def _short(name: object) -> str:
    return repr(str(name)[:60])
