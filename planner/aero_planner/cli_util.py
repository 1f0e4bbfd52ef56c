"""Helpers of command-line programs: exit codes, versions, errors. This module imports nothing heavy."""

from __future__ import annotations

import argparse
import contextlib
import gc
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import NoReturn

from aero_planner.plain_text import say
from aero_planner.termination import install_handler

INTERRUPTED = 130
"""Exit code after Ctrl-C or SIGTERM."""


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one sentence."""

    def error(self, message: str) -> NoReturn:
        """Raise a ValueError."""
        raise ValueError(f"{message}; see {self.prog} --help.")


@contextlib.contextmanager
def quick_imports() -> Iterator[None]:
    """Pause the garbage collector, and exempt from it what was imported meanwhile; for the start of a program only.

    It would look through all that was imported before again and again, a quarter of the time that a command takes to
    start.
    """
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


def abandon_output() -> int:
    """Discard the rest of stdout, whose reader, such as `head`, has closed it; return the exit code for that."""
    # Python would report the error again when it flushes stdout at exit.
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 141


def installed_version(distribution: str) -> str:
    """Return the version of a distribution, or "(not installed)", as when it runs from its sources."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(distribution)
    except PackageNotFoundError:
        return "(not installed)"


def run_command(command: Callable[[Sequence[str] | None], int]) -> None:
    """Run the `main` function of a module and exit; a ValueError or OSError becomes one line on stderr and code 2.

    Ctrl-C and SIGTERM give code 130.
    """
    install_handler()
    try:
        code = command(None)
        sys.stdout.flush()
    except BrokenPipeError:
        code = abandon_output()
    except KeyboardInterrupt:
        code = INTERRUPTED
    except (ValueError, OSError) as error:
        say(error, file=sys.stderr)
        code = 2
    sys.exit(code)
