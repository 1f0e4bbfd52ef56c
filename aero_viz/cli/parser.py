"""From command-line arguments to a function call. tyro parses the flags of a verb and reports mistakes in them."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from aero_planner.config.parameter import did_you_mean
from aero_viz.errors import UserError


@dataclass(frozen=True)
class Verb:
    """One verb of a command line."""

    load: Callable[[], Callable[..., None]]
    """Imports and returns the function. tyro makes flags from its parameters and docstring."""
    summary: str
    """First sentence of the function's docstring, for the list of verbs."""


def parse(verbs: Mapping[str, Verb], arguments: Sequence[str], *, prog: str, description: str) -> Callable[[], None]:
    """Return the call that the arguments ask for, without making it.

    Only the requested verb is imported, and only its parser is built, because both take a while.

    Args:
        verbs: verbs by name.
        arguments: arguments without the program's name.
        prog: name of the program.
        description: description of the program for --help.

    Raises:
        UserError: no verb or an unknown verb was requested.
        SystemExit: code 0 after help has been printed, 2 after tyro has reported a mistake on stderr.
    """
    for words in (2, 1):  # "bench compare" before "bench"
        name = " ".join(arguments[:words])
        if name in verbs:
            import tyro

            return tyro.cli(_deferred(verbs[name].load()), prog=f"{prog} {name}", args=arguments[words:])
    first = arguments[0] if arguments else ""
    if first in ("-h", "--help"):
        print(_format_help(verbs, prog=prog, description=description))
        raise SystemExit(0)
    if first.startswith("--tyro-"):  # shell completion
        return _parse_with_all_verbs(verbs, arguments, prog=prog)
    mistake = f"there is no verb {first!r}{did_you_mean(first, verbs)}" if first else "a verb is missing"
    raise UserError(f"{mistake}; give one of {', '.join(verbs)}, or --help.")


def _deferred(function: Callable[..., None]) -> Callable[..., Callable[[], None]]:
    """Return a function with the same flags that returns the call instead of making it."""

    @functools.wraps(function)
    def bind(*args: Any, **kwargs: Any) -> Callable[[], None]:
        return functools.partial(function, *args, **kwargs)

    return bind


def _format_help(verbs: Mapping[str, Verb], *, prog: str, description: str) -> str:
    width = max(map(len, verbs))
    lines = [f"  {name:{width}}  {verb.summary}" for name, verb in verbs.items()]
    return "\n".join(
        [f"usage: {prog} VERB ...", "", description, "", "verbs:", *lines, "", f"Flags of a verb: {prog} VERB --help"]
    )


def _parse_with_all_verbs(verbs: Mapping[str, Verb], arguments: Sequence[str], *, prog: str) -> Callable[[], None]:
    import tyro

    app: Any = tyro.extras.SubcommandApp()
    for name, verb in verbs.items():
        if " " in name:
            continue  # the shell completes the first word
        app.command(_deferred(verb.load()), name=name)
    return app.cli(prog=prog, args=arguments)
