"""The storages of studies. A file may come from a stranger, so it is checked before Optuna opens it."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from aero_viz.errors import UserError
from aero_viz.plain_sqlite import check_schema, connect_read_only, limit_time

if TYPE_CHECKING:
    from optuna.storages import RDBStorage


def first_line(error: Exception) -> str:
    """Return the first line of an error's message, or its type if it has none."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]


def sqlite_file(storage: str) -> Path | None:
    """Return the file of a storage's URL, None if it is no file of SQLite.

    Raises:
        UserError: it is none of the URLs of SQLAlchemy, or one that names its file in the form of SQLite's URIs.
    """
    from sqlalchemy.engine import make_url
    from sqlalchemy.exc import ArgumentError

    try:
        url = make_url(storage)
    except (ArgumentError, ValueError) as error:
        raise UserError(
            f"{storage} is no URL of a storage; give one such as sqlite:///results/tune.db, or memory."
        ) from error
    if url.get_backend_name() != "sqlite" or url.database in (None, "", ":memory:"):
        return None
    if str(url.database).startswith("file:"):
        raise UserError(f"{storage} names its file as file:..; give sqlite:///PATH.")
    return Path(str(url.database))


def check_file(path: Path) -> None:
    """Check that an existing file holds studies of Optuna, which would add them to a database of any kind.

    Raises:
        UserError: it does not.
    """
    try:
        database = connect_read_only(path, is_written=True)
        try:
            limit_time(database, path)
            check_schema(database)
            names = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        finally:
            database.close()
    except ValueError as error:
        raise UserError(f"{path} {error}: it is no storage of studies; give another --storage.") from error
    except (OSError, sqlite3.Error) as error:
        reason = getattr(error, "strerror", None) or error
        raise UserError(f"{path} cannot be read as a storage of studies: {reason}; give another --storage.") from error
    if "studies" not in names:
        raise UserError(f"{path} is a database without studies of Optuna; give another --storage.")


def read_only_storage(storage: str, path: Path) -> tuple[RDBStorage, Callable[[], object]]:
    """Return a storage in a file that `check_file` accepts, and a function to call before each use of it.

    It cannot be changed. The function gives what follows the time that the size of the file allows.

    Raises:
        UserError: it cannot be read.
    """
    from optuna.storages import RDBStorage
    from sqlalchemy.pool import StaticPool

    try:
        database = connect_read_only(path, is_written=True)
        limit_time(database, path)
        options = {"creator": lambda: database, "poolclass": StaticPool}
        return RDBStorage(storage, options, skip_table_creation=True), partial(limit_time, database, path)
    except Exception as error:  # SQLAlchemy and database drivers raise their own exceptions
        raise UserError(f"Cannot read the storage {storage} of Optuna: {first_line(error)}") from error
