"""Parsing of arguments, and how tyro reports what is wrong with them."""

import os
import subprocess
import sys
from typing import Annotated, Literal

import pytest
import tyro

from aero_viz.cli.parser import Command, parse
from aero_viz.errors import UserError

CALLS: list[tuple[object, ...]] = []


def paint(
    wall: tyro.conf.Positional[Annotated[str, tyro.conf.arg(metavar="WALL")]],
    *,
    coats: int = 1,
    place: tuple[float, float, float] | None = None,
    colour: Literal["red", "green"] = "red",
    gloss: float | None = None,
    layers: int | None = None,
    finish: Literal["matt", "silk"] | None = None,
) -> None:
    """Paint a wall.

    Args:
        wall: name of the wall.
        coats: number of coats. This text is long enough to be broken into two lines in the box that tyro draws.
        place: position.
        colour: colour of the paint.
        gloss: gloss of the paint.
        layers: layers of the paint.
        finish: finish of the paint.
    """
    CALLS.append((wall, coats, place, colour, gloss, layers, finish))


def wash(*, soap: str) -> None:
    """Wash.

    Args:
        soap: name of the soap.
    """
    CALLS.append(("wash", soap))


COMMANDS = {"paint": Command(lambda: paint, "Paint a wall."), "wash": Command(lambda: wash, "Wash.")}


def call(*arguments: str):
    return parse(COMMANDS, arguments, prog="house", description="A house.")


def test_parsing_does_not_call_the_command():
    CALLS.clear()
    command = call("paint", "north", "--coats", "2", "--place", "1", "-2", "3e1")
    assert CALLS == []
    command()
    call("wash", "--soap", "hard")()
    assert CALLS == [("north", 2, (1.0, -2.0, 30.0), "red", None, None, None), ("wash", "hard")]


@pytest.mark.parametrize(
    ("arguments", "messages"),
    [
        ("paint north --coat 2", ["Unrecognized options: --coat", "meant", "--coats INT", "house paint --help"]),
        ("paint north south", ["Unrecognized options: south", "house paint --help"]),
        ("paint", ["Missing from house paint:", "WALL", "house paint --help"]),
        ("paint north --coats two", ["Error parsing --coats: 'two' is not a whole number"]),
        ("paint north --layers two", ["Error parsing --layers: 'two' is not a whole number"]),
        ("paint north --gloss much", ["Error parsing --gloss: 'much' is not a number"]),
        ("paint north --place 1 2", ["Missing value for argument '--place'. Expected 3 values"]),
        ("paint north --place 1 2 far", ["Error parsing --place: '1 2 far' does not fit FLOAT FLOAT FLOAT"]),
        ("paint north --finish gold", ["'gold' for argument '--finish'. Expected one of ('matt', 'silk')"]),
        ("paint north --gloss None", ["Error parsing --gloss: 'None' is not a number"]),
        ("paint north --colour blue", ["invalid choice 'blue' for argument '--colour'", "'red', 'green'"]),
        ("paint north --coats", ["Missing value for argument '--coats'"]),
        ("wash --sope hard", ["--soap STR", "--sope hard", "house wash --help"]),
    ],
)
def test_a_mistake_in_a_flag_is_one_sentence(capsys: pytest.CaptureFixture[str], arguments: str, messages: list[str]):
    with pytest.raises(UserError) as caught:
        call(*arguments.split())
    error, captured = str(caught.value), capsys.readouterr()
    assert (captured.out, captured.err) == ("", "") and error.endswith("--help.") and "─" not in error
    assert all(message in error for message in messages), error


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("paintt north", "there is no command 'paintt' (did you mean 'paint'?); give one of paint, wash, or --help."),
        ("", "a command is missing; give one of paint, wash, or --help."),
        ("--coats 2", "there is no command '--coats'; give one of paint, wash, or --help."),
    ],
)
def test_a_wrong_command_is_reported_in_one_sentence(arguments: str, message: str):
    with pytest.raises(UserError) as caught:
        call(*arguments.split())
    assert str(caught.value) == message


@pytest.mark.parametrize(
    "environment", [{"COLUMNS": "40"}, {"LC_ALL": "C", "PYTHONIOENCODING": "ascii"}, {"FORCE_COLOR": "1"}]
)
def test_mistakes_are_reported_on_any_terminal(environment: dict[str, str]):
    command = [sys.executable, "-m", "aero_viz", "score", "a.csv", "--world", "b.json", "--plannr", "x"]
    result = subprocess.run(command, capture_output=True, text=True, env=os.environ | environment, timeout=60)
    assert (result.returncode, result.stdout) == (2, "")
    assert "--plannr" in result.stderr and "--planner STR" in result.stderr and "Traceback" not in result.stderr


def test_help_is_complete(capsys: pytest.CaptureFixture[str]):
    for arguments, shown in ((["--help"], "Paint a wall."), (["paint", "--help"], "--coats INT")):
        with pytest.raises(SystemExit) as end:
            call(*arguments)
        assert not end.value.code and shown in capsys.readouterr().out
