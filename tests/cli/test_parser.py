"""What tyro rejects, as one sentence."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Annotated, Literal

import pytest
import tyro

from aero_viz.cli.parser import parse
from aero_viz.errors import UserError

CALLS: list[tuple] = []


def paint(
    wall: tyro.conf.Positional[Annotated[str, tyro.conf.arg(metavar="WALL")]],
    *,
    coats: int = 1,
    place: tuple[float, float, float] | None = None,
    colour: Literal["red", "green"] = "red",
    gloss: float | None = None,
    layers: int | None = None,
) -> None:
    """Paint a wall.

    Args:
        wall: which.
        coats: how many, and as this text is long enough to be broken by any box that it is drawn into, in two lines.
        place: where.
        colour: of the paint.
        gloss: of the paint.
        layers: of the paint.
    """
    CALLS.append((wall, coats, place, colour, gloss, layers))


def wash(*, soap: str) -> None:
    """Wash.

    Args:
        soap: which.
    """
    CALLS.append(("wash", soap))


VERBS = {"paint": paint, "wash": wash}


def call(*arguments: str):
    return parse(VERBS, arguments, prog="house", description="A house.")


def refused(*arguments: str) -> str:
    with pytest.raises(UserError) as caught:
        call(*arguments)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_parsing_does_not_call_yet() -> None:
    CALLS.clear()
    verb = call("paint", "north", "--coats", "2", "--place", "1", "-2", "3e1")
    assert CALLS == []
    verb()
    call("wash", "--soap", "hard")()
    assert CALLS == [("north", 2, (1.0, -2.0, 30.0), "red", None, None), ("wash", "hard")]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("paint north --coat 2", "Unrecognized options: --coat, 2 (did you mean --coats?); see house paint --help."),
        ("paint north south", "Unrecognized options: south; see house paint --help."),
        ("paint", "Missing from house paint: WALL; see house paint --help."),
        ("paint north --coats two", "Error parsing --coats: 'two' is no whole number; see house paint --help."),
        ("paint north --layers two", "Error parsing --layers: 'two' is no whole number; see house paint --help."),
        ("paint north --gloss much", "Error parsing --gloss: 'much' is no number; see house paint --help."),
        ("paint north --place 1 2", "Error parsing --place: '1', '2' must be FLOAT FLOAT FLOAT; see house paint"),
        (
            "paint north --colour blue",
            "invalid choice 'blue' for argument '--colour'; expected one of ('red',",
        ),
        ("paint north --coats", "Missing value for argument '--coats'"),
        ("paintt north", "there is no verb 'paintt' (did you mean 'paint'?); give one of paint, wash, or --help."),
        ("", "a verb is missing; give one of paint, wash, or --help."),
        ("wash --sope hard", "Missing from house wash: --soap STR, and unrecognized options: --sope hard; see house"),
        ("--coats 2", "there is no verb '--coats'; give one of paint, wash, or --help."),
    ],
)
def test_mistakes_are_one_sentence(arguments: str, message: str) -> None:
    assert refused(*arguments.split()).startswith(message)


@pytest.mark.parametrize(
    "environment", [{"COLUMNS": "40"}, {"LC_ALL": "C", "PYTHONIOENCODING": "ascii"}, {"FORCE_COLOR": "1"}]
)
def test_the_sentence_does_not_depend_on_the_terminal(environment: dict[str, str]) -> None:
    command = [sys.executable, "-m", "aero_viz", "score", "a.csv", "--world", "b.json", "--plannr", "x"]
    result = subprocess.run(command, capture_output=True, text=True, env=os.environ | environment, timeout=60)
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr == (
        "aero-viz: Unrecognized options: --plannr, x (did you mean --planner?); see aero-viz score --help.\n"
    )


def test_help_is_printed_whole(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, shown in ((["--help"], "Paint a wall."), (["paint", "--help"], "--coats INT")):
        with pytest.raises(SystemExit) as end:
            call(*arguments)
        assert not end.value.code and shown in capsys.readouterr().out
