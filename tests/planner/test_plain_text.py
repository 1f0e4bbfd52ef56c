"""What reaches the terminal: no control characters, and no errors in the words of others without saying so."""

import json
import logging

import pytest

from aero_planner.config.file import load_config
from aero_planner.plain_text import PlainFormatter, has_own_words, in_own_words, one_line, printable, say

HOSTILE = "a\x1b]0;title\x07\x1b[31m\x9b5m\x7f\rb\u202ec\udcff\x00d"


@pytest.mark.parametrize("make", [printable, one_line, lambda text: PlainFormatter().format(record(text))])
def test_nothing_controls_the_terminal(make):
    shown = make(HOSTILE)
    assert shown.isprintable() and shown.encode() and "title" in shown and shown.endswith("d")


def record(text: str) -> logging.LogRecord:
    return logging.LogRecord("x", logging.WARNING, "", 0, "%s", (text,), None)


def test_lines_tabs_and_letters_stay(capsys: pytest.CaptureFixture[str]):
    say("a\tb\nc", 3, "m² äöü 漢字 →", sep="|", end=".\n")
    assert capsys.readouterr().out == "a\tb\nc|3|m² äöü 漢字 →.\n"
    say(HOSTILE)
    assert capsys.readouterr().out.strip().isprintable()
    assert one_line(" a \n b\t") == "a b"


def foreign_errors():
    return [
        lambda: int("9" * 5000), lambda: [][0], lambda: json.loads("{"), lambda: bytes(2)[:1].decode("x"),
        lambda: (1,).index(2), lambda: "a".encode("no such"),
    ]  # fmt: skip


@pytest.mark.parametrize("fail", foreign_errors())
def test_an_error_of_python_is_framed(fail):
    with pytest.raises(Exception) as caught:
        fail()
    assert not has_own_words(caught.value)
    assert in_own_words(caught.value).startswith(f"unexpected {type(caught.value).__name__}: ")


def test_an_error_of_ours_is_shown_as_it_is(tmp_path):
    with pytest.raises(ValueError, match="can't be read") as caught:
        load_config(tmp_path / "absent.yaml")
    assert has_own_words(caught.value) and in_own_words(caught.value) == str(caught.value)
    assert not has_own_words(ValueError("never raised"))
