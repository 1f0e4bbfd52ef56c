"""From command-line arguments to a function call. tyro parses the flags of a command and reports mistakes in them."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from aero_planner.config.parameter import did_you_mean
from aero_viz.errors import UserError


@dataclass(frozen=True)
class Command:
    """One command of a command line."""

    load: Callable[[], Callable[..., None]]
    """Imports and returns the function. tyro makes flags from its parameters and docstring."""
    summary: str
    """First sentence of the function's docstring, for the list of commands."""


def parse(
    commands: Mapping[str, Command], arguments: Sequence[str], *, prog: str, description: str
) -> Callable[[], None]:
    """Return the call that the arguments ask for, without making it.

    Only the requested command is imported, and only its parser is built, because both take a while.

    Args:
        commands: commands by name.
        arguments: arguments without the program's name.
        prog: name of the program.
        description: description of the program for --help.

    Raises:
        UserError: no command or an unknown command was requested.
        SystemExit: code 0 after help has been printed, 2 after tyro has reported a mistake on stderr.
    """
    for words in (2, 1):  # "bench compare" before "bench"
        name = " ".join(arguments[:words])
        if name in commands:
            import tyro

            return tyro.cli(_deferred(commands[name].load()), prog=f"{prog} {name}", args=arguments[words:])
    first = arguments[0] if arguments else ""
    if first in ("-h", "--help"):
        print(_format_help(commands, prog=prog, description=description))
        raise SystemExit(0)
    if first.startswith("--tyro-"):  # shell completion
        return _parse_with_all(commands, arguments, prog=prog)
    is_group = any(name.startswith(f"{first} ") for name in commands)
    given = " ".join(arguments[: 2 if is_group else 1])
    mistake = f"there is no command {given!r}{did_you_mean(given, commands)}" if given else "a command is missing"
    raise UserError(f"{mistake}; give one of {', '.join(commands)}, or --help.")


def _deferred(function: Callable[..., None]) -> Callable[..., Callable[[], None]]:
    """Return a function with the same flags that returns the call instead of making it."""

    @functools.wraps(function)
    def bind(*args: Any, **kwargs: Any) -> Callable[[], None]:
        return functools.partial(function, *args, **kwargs)

    return bind


def _format_help(commands: Mapping[str, Command], *, prog: str, description: str) -> str:
    width = max(map(len, commands))
    lines = [f"  {name:{width}}  {command.summary}" for name, command in commands.items()]
    return "\n".join(
        [f"usage: {prog} COMMAND ...", "", description, "", "commands:", *lines, "", f"Flags: {prog} COMMAND --help"]
    )


def _parse_with_all(commands: Mapping[str, Command], arguments: Sequence[str], *, prog: str) -> Callable[[], None]:
    import tyro

    app: Any = tyro.extras.SubcommandApp()
    for name, command in commands.items():
        if " " in name:
            continue  # the shell completes the first word
        app.command(_deferred(command.load()), name=name)
    return app.cli(prog=prog, args=arguments)
