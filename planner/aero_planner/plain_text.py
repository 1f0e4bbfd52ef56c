"""Text for people: what a file, a message or a library holds reaches the terminal without control characters."""

from __future__ import annotations

import logging
import sys
from typing import TextIO

_PACKAGES = ("aero_planner", "aero_viz")


def printable(text: str) -> str:
    """Return a text with a "?" in place of what would control a terminal, or that it cannot show.

    These are control characters other than line feeds and tabs, marks that change the direction of writing, and halves
    of characters, such as a file name that is not UTF-8 has.
    """
    return "".join(letter if letter.isprintable() or letter in "\n\t" else "?" for letter in text)


def say(*texts: object, sep: str = " ", end: str = "\n", file: TextIO | None = None, flush: bool = False) -> None:
    """Print texts, without control characters."""
    print(printable(sep.join(map(str, texts))), end=end, file=sys.stdout if file is None else file, flush=flush)


def one_line(text: object) -> str:
    """Return a text as one printable line."""
    return printable(" ".join(str(text).split()))


def has_own_words(error: BaseException) -> bool:
    """Return True if one of our modules raised an error itself, so that its text was written for the user.

    It was not if a library, or a function of Python such as `int`, raised it.
    """
    trace = error.__traceback__
    if trace is None:
        return False
    while trace.tb_next is not None:
        trace = trace.tb_next
    import dis

    module = str(trace.tb_frame.f_globals.get("__name__", ""))
    instruction = trace.tb_frame.f_code.co_code[trace.tb_lasti]
    return module.split(".")[0] in _PACKAGES and instruction == dis.opmap["RAISE_VARARGS"]


def in_own_words(error: BaseException) -> str:
    """Return the text of an error; one that we have not written is framed as what it is."""
    if has_own_words(error):
        return str(error)
    return f"unexpected {type(error).__name__}: {str(error).rstrip('.')}. Please report it, if the input is right."


class PlainFormatter(logging.Formatter):
    """Formats records without control characters."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the text of a record."""
        return printable(super().format(record))


def log_plainly() -> None:
    """Let the warnings of a program that has not set up logging reach the terminal without control characters."""
    if logging.lastResort is not None:
        logging.lastResort.setFormatter(PlainFormatter())
