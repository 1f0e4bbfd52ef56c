"""From command-line arguments to a function call. tyro parses the flags of a command and reports mistakes in them."""

from __future__ import annotations

import contextlib
import functools
import importlib
import inspect
import io
import itertools
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import NoneType
from typing import TYPE_CHECKING, Any, get_args, get_origin

from aero_planner.cli_util import installed_version
from aero_planner.parameters import did_you_mean
from aero_planner.plain_text import say
from aero_viz.errors import UserError
from aero_viz.seed_range import check_seed

if TYPE_CHECKING:
    from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo


@dataclass(frozen=True)
class Command:
    """One command of a command line."""

    load: Callable[[], Callable[..., None]]
    """Imports and returns the function. tyro makes flags from its parameters and docstring."""
    summary: str
    """First sentence of the function's docstring, for the list of commands."""
    needs: str = ""
    """Module that the function imports before all else, and that takes a while to import."""


def parse(
    commands: Mapping[str, Command], arguments: Sequence[str], *, prog: str, description: str
) -> Callable[[], None]:
    """Return the call that the arguments ask for, without making it.

    Only the requested command is imported, and only its parser is built, because both take a while. What it needs is
    imported once its flags are right.

    Args:
        commands: commands by name.
        arguments: arguments without the program's name.
        prog: name of the program.
        description: description of the program for --help.

    Raises:
        UserError: no command or an unknown command was requested, a flag is wrong, or the seed is out of range.
        SystemExit: code 0 after help or the version has been printed.
    """
    for words in (2, 1):  # "bench compare" before "bench"
        name = " ".join(arguments[:words])
        if name in commands:
            import tyro

            command = commands[name]
            function = _with_flags_of_planner(command.load(), arguments[words:])
            with _value_rules(), _one_sentence(f"{prog} {name}"):
                call = tyro.cli(_deferred(function), prog=f"{prog} {name}", args=arguments[words:])
            if command.needs:
                importlib.import_module(command.needs)
            return call
    first = arguments[0] if arguments else ""
    if first in ("-h", "--help"):
        say(_format_help(commands, prog=prog, description=description))
        raise SystemExit(0)
    if first == "--version":
        say(", ".join(f"{name} {installed_version(name)}" for name in ("aero-viz", "aero-planner", "warp-lang")))
        raise SystemExit(0)
    if first.startswith("--tyro-"):  # shell completion
        return _parse_with_all(commands, arguments, prog=prog)
    is_group = any(name.startswith(f"{first} ") for name in commands)
    given = " ".join(arguments[: 2 if is_group else 1])
    mistake = f"there is no command {given!r}{did_you_mean(given, commands)}" if given else "a command is missing"
    raise UserError(f"{mistake}; give one of {', '.join(commands)}, or --help.")


def _with_flags_of_planner(function: Callable[..., None], arguments: Sequence[str]) -> Callable[..., None]:
    """Return a command with the flags of the planner that --planner names, in place of those of AERO-MPPI.

    Raises:
        UserError: there is no such planner.
    """
    if "config_flags" not in function.__annotations__:
        return function
    named = [value for flag, value in itertools.pairwise(arguments) if flag == "--planner"]
    named += [flag.removeprefix("--planner=") for flag in arguments if flag.startswith("--planner=")]
    if not named:
        return function
    from aero_viz.cli.flags import Inline, config_flags_type

    flags = config_flags_type(named[-1])

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> None:
        function(*args, **kwargs)

    signature = inspect.signature(function)
    default = signature.parameters["config_flags"].replace(default=flags())
    call.__annotations__ = {**function.__annotations__, "config_flags": Inline[flags]}
    call.__dict__["__signature__"] = signature.replace(
        parameters=list({**signature.parameters, "config_flags": default}.values())
    )
    return call


@contextlib.contextmanager
def _one_sentence(command: str) -> Iterator[None]:
    """Turn the box in which tyro reports a mistake into a UserError."""
    with contextlib.redirect_stderr(io.StringIO()) as shown:
        try:
            yield
            return
        except SystemExit as end:
            if not end.code:
                raise
    # The first line of a box is its title, lines of dashes separate its parts, and the last part points to the help.
    lines = [line.strip("│ ") for line in shown.getvalue().splitlines() if not line.startswith(("╭", "╰"))]
    parts = [" ".join(part.split()).rstrip(".") for part in re.split("─{3,}", "\n".join(lines))]
    told = "; ".join(part for part in parts if part and not part.startswith("For full helptext"))
    raise UserError(f"{told or 'The flags are not understood'}; see {command} --help.")


def _deferred(function: Callable[..., None]) -> Callable[..., Callable[[], None]]:
    """Return a function with the same flags that returns the call instead of making it."""

    @functools.wraps(function)
    def bind(*args: Any, **kwargs: Any) -> Callable[[], None]:
        if "seed" in kwargs:
            check_seed(kwargs["seed"])
        return functools.partial(function, *args, **kwargs)

    return bind


def _value_rules() -> ConstructorRegistry:
    """Return how tyro reads the values of flags, where its own rules give messages in terms of Python."""
    from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

    rules = ConstructorRegistry()

    @rules.primitive_rule
    def number(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
        kind = info.type
        if kind not in (int, float):
            return None

        def read(values: list[str]) -> float:
            try:
                return kind(values[0])
            except ValueError:
                raise ValueError(f"{values[0]!r} is not a {'whole ' if kind is int else ''}number") from None

        return PrimitiveConstructorSpec(
            nargs=1,
            metavar=kind.__name__.upper(),
            instance_from_str=read,
            is_instance=lambda value: isinstance(value, int | kind) and not isinstance(value, bool),
            str_from_instance=lambda value: [str(value)],
        )

    @rules.primitive_rule
    def optional(info: PrimitiveTypeInfo) -> Any:
        # None stands for a flag that is absent. It is no value that a user could give.
        kinds = [kind for kind in get_args(info.type) if kind is not NoneType]
        if NoneType not in get_args(info.type) or len(kinds) != 1:
            return None
        spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kinds[0], info.markers))
        if not isinstance(spec, PrimitiveConstructorSpec):
            return spec  # an error

        def read_tuple(values: list[str]) -> Any:
            try:
                return spec.instance_from_str(values)
            except ValueError:
                raise ValueError(f"{' '.join(values)!r} does not fit {spec.metavar}") from None

        return replace(
            spec,
            instance_from_str=read_tuple if get_origin(kinds[0]) is tuple else spec.instance_from_str,
            is_instance=lambda value: value is None or spec.is_instance(value),
            str_from_instance=lambda value: ["none"] if value is None else spec.str_from_instance(value),
        )

    return rules


def _format_help(commands: Mapping[str, Command], *, prog: str, description: str) -> str:
    width = max(map(len, commands))
    lines = [f"  {name:{width}}  {command.summary}" for name, command in commands.items()]
    hints = [f"Flags: {prog} COMMAND --help", f"Version: {prog} --version"]
    return "\n".join([f"usage: {prog} COMMAND ...", "", description, "", "commands:", *lines, "", *hints])


def _parse_with_all(commands: Mapping[str, Command], arguments: Sequence[str], *, prog: str) -> Callable[[], None]:
    import tyro

    app: Any = tyro.extras.SubcommandApp()
    for name, command in commands.items():
        if " " in name:
            continue  # the shell completes the first word
        app.command(_deferred(command.load()), name=name)
    with _value_rules():
        return app.cli(prog=prog, args=arguments)
