"""The progress bar of the command line."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

__all__ = ["progress_bar"]


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
