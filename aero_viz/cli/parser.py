"""From arguments to a call: tyro parses, and what is wrong becomes one sentence instead of a box."""

from __future__ import annotations

import contextlib
import functools
import io
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import tyro

from aero_planner.config.parameter import did_you_mean
from aero_viz.errors import UserError

__all__ = ["parse"]

_BORDER = "╭╮╰╯│─┌┐└┘|+- "
_PHRASES = {
    r"invalid literal for int\(\) with base 10: (.*)": r"\1 is no whole number",
    r"could not convert string to float: (.*)": r"\1 is no number",
    r"no type matching (?:\{None\}\|)?\{?FLOAT\}? could be instantiated from \[('[^']*')\]": r"\1 is no number",
    r"no type matching (?:\{None\}\|)?\{?INT\}? could be instantiated from \[('[^']*')\]": r"\1 is no whole number",
    r"no type matching (?:\{None\}\|)?\{?(.*?)\}? could be instantiated from \[(.*)\]": r"\2 must be \1",
    r"\. Expected": "; expected",
}
"""What tyro says, and what a user reads instead."""


def parse(
    verbs: Mapping[str, Callable[..., None]], arguments: Sequence[str], *, prog: str, description: str
) -> Callable[[], None]:
    """Return the call that the arguments ask for, not yet made.

    Only the parser of the verb that is asked for is built: a command line of hundreds of flags takes a while.

    Args:
        verbs: function of each verb; tyro makes flags from its parameters and docstring.
        arguments: without the program's name.
        prog: name of the program.
        description: of the program, for --help.

    Raises:
        UserError: the arguments do not fit, with the nearest that would.
        SystemExit: they ask for help, which has been printed.
    """
    first = arguments[0] if arguments else ""
    if first in verbs:
        verb = _deferred(verbs[first])
        return _parsed(lambda: tyro.cli(verb, prog=f"{prog} {first}", args=arguments[1:]), help=f"{prog} {first}")
    if first not in ("-h", "--help") and not first.startswith("--tyro-"):
        what = f"there is no verb {first!r}{did_you_mean(first, verbs)}" if first else "a verb is missing"
        raise UserError(f"{what}; give one of {', '.join(verbs)}, or --help.")
    app: Any = tyro.extras.SubcommandApp()
    for name, verb in verbs.items():
        app.command(_deferred(verb), name=name)
    return _parsed(lambda: app.cli(prog=prog, description=description, args=arguments), help=prog)


def _deferred(verb: Callable[..., None]) -> Callable[..., Any]:
    @functools.wraps(verb)
    def later(*values: Any, **options: Any) -> Callable[[], None]:
        return functools.partial(verb, *values, **options)

    return later


def _parsed(parser: Callable[[], Any], *, help: str) -> Any:
    told = io.StringIO()
    try:
        with contextlib.redirect_stderr(told):
            return parser()
    except SystemExit as end:
        if not end.code:
            raise
        raise UserError(f"{_sentence(told.getvalue())}; see {help} --help.") from None


def _sentence(box: str) -> str:
    """Return what a box of tyro's says: its first paragraph, what it does not know, and what it offers instead."""
    paragraphs: list[list[str]] = [[]]
    for line in box.splitlines()[1:]:  # the first holds the title
        if line.strip(_BORDER):
            paragraphs[-1].append(line[2:].rstrip(_BORDER))
        elif paragraphs[-1]:
            paragraphs.append([])
    first, *others = paragraphs
    # Rows that are set in deep are explanations.
    said = " ".join(row.strip() for row in first if not row.startswith(8 * " "))
    for python, english in _PHRASES.items():
        said = re.sub(python, english, said)
    offered: list[str] = []
    for heading, *rows in (rows for rows in others if rows):
        if heading.startswith("Unrecognized options"):
            said += f", and unrecognized options: {' '.join(row.strip() for row in rows)}"
        elif not heading.startswith("Argument helptext"):
            offered += [row.split()[0] for row in rows if row.startswith("    --")]
    hint = f" (did you mean {' or '.join(dict.fromkeys(offered))}?)" if offered else ""
    return said.rstrip(".") + hint
