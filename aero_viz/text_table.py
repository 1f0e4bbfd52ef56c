"""Plain-text tables and sizes for terminals and pipes."""

from __future__ import annotations

import io
from collections.abc import Sequence

from aero_planner.plain_text import one_line

_MAX_WIDTH = 10_000
"""Lines are never wrapped, so that a table reads the same in a terminal and in a pipe."""


def format_table(rows: Sequence[Sequence[str]], *, header: Sequence[str] = (), right: Sequence[int] = ()) -> str:
    """Return rows of cells as text in aligned columns. A control character, as a damaged file may hold, becomes a "?".

    Args:
        rows: cells of each row.
        header: names of the columns; empty for a table without a header.
        right: indices of the columns that are aligned to the right.
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, show_header=bool(header), pad_edge=False, padding=(0, 2, 0, 0))
    for column in range(max(map(len, [header, *rows]), default=0)):
        name = Text(header[column]) if header else ""
        table.add_column(name, justify="right" if column in right else "left", no_wrap=True)
    for row in rows:
        table.add_row(*(Text(one_line(cell)) for cell in row))
    console = Console(file=io.StringIO(), width=_MAX_WIDTH, color_system=None)
    with console.capture() as capture:
        console.print(table)
    return "\n".join(line.rstrip() for line in capture.get().splitlines())


def format_size(size: int) -> str:
    """Return the size of a file [bytes] as text, such as "12 kB" or "3.4 MB"."""
    return f"{size / 1e6:.1f} MB" if size >= 1e6 else f"{size / 1e3:.1f} kB"
