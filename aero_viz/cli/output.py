"""The output of the command line: reports on stdout and a progress bar on stderr."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator
from typing import Any, Protocol

from aero_planner.plain_text import say


class Report(Protocol):
    """A result that a command prints."""

    def to_dict(self) -> dict[str, Any]:
        """Return the report as plain values for JSON."""
        ...

    def format_table(self) -> str:
        """Return the report as text for a terminal."""
        ...


def print_json(content: dict[str, Any]) -> None:
    """Print one JSON object in one line. Raises ValueError for numbers that JSON does not have."""
    say(json.dumps(content, allow_nan=False))


def print_report(report: Report, *, as_json: bool) -> None:
    """Print a report as one JSON object or as text."""
    if as_json:
        print_json(report.to_dict())
    else:
        say(report.format_table())


@contextlib.contextmanager
def progress_bar(label: str = "", *, enabled: bool = True) -> Iterator[Callable[[float, float, str], None]]:
    """Show a progress bar on stderr while the context is open, if it is enabled and stderr is a terminal.

    The context's value is a function that updates the bar. Its arguments are the amount that is done, the total amount,
    and a text to show next to the bar.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.fields[status]}", markup=False),
        TimeElapsedColumn(),
    )
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not (enabled and console.is_terminal)) as progress:
        task = progress.add_task(label, status="")

        def update(completed: float, total: float, status: str) -> None:
            progress.update(task, completed=completed, total=total, status=status)

        yield update
