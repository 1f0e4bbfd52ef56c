"""How a program of the command line ends, whatever it does. Nothing heavy is imported here."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence

__all__ = ["INTERRUPTED", "abandon_output", "run_command"]

INTERRUPTED = 130
"""Exit code after Ctrl-C."""


def abandon_output() -> int:
    """Drop what is left of stdout, whose reader, such as `head`, has gone; return the exit code that says so."""
    # Python would complain once more when it flushes at exit.
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 141


def run_command(command: Callable[[Sequence[str] | None], int]) -> None:
    """Run the `main` of a module and exit; a mistake of the user's is one line and exit code 2."""
    try:
        code = command(None)
        sys.stdout.flush()
    except BrokenPipeError:
        code = abandon_output()
    except KeyboardInterrupt:
        code = INTERRUPTED
    except (ValueError, OSError) as error:
        print(error, file=sys.stderr)
        code = 2
    sys.exit(code)
