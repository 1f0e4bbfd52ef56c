"""The entry point of `aero-viz`. Its imports are inside `main`, so that Ctrl-C during start-up also ends quietly."""

from __future__ import annotations

import contextlib
import os
import sys

from aero_planner.cli_util import INTERRUPTED, abandon_output, quick_imports
from aero_planner.plain_text import in_own_words, log_plainly, one_line, say
from aero_planner.termination import install_handler
from aero_viz.errors import UserError

__all__ = ["main"]

_DESCRIPTION = "AERO-Viz: the AERO-MPPI planner, live in the browser."


def _refuse(message: str, arguments: list[str] | None) -> None:
    """Print a message on stderr and, for whoever reads the JSON of --json, as one JSON object on stdout."""
    message = one_line(message)
    say(f"aero-viz: {message}", file=sys.stderr)
    if "--json" in (sys.argv[1:] if arguments is None else arguments):
        import json

        with contextlib.suppress(OSError, ValueError):
            say(json.dumps({"error": message}))
            sys.stdout.flush()


def main(arguments: list[str] | None = None) -> None:
    """Run the command line.

    Args:
        arguments: arguments without the program's name; None takes them from sys.argv.

    Raises:
        SystemExit: code 2 for a user's mistake or unreadable input, whose message --json prints as JSON, too; 130
            after Ctrl-C or SIGTERM, 0 after --help.
    """
    if sys.stdout is None:  # closed by the shell, as with >&-
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 (open until the end)
    install_handler()
    log_plainly()
    try:
        with quick_imports() if arguments is None else contextlib.nullcontext():
            from aero_viz.cli.commands import COMMANDS
            from aero_viz.cli.parser import parse
            from aero_viz.cli.renamed_flags import replace_renamed_flags

            current = replace_renamed_flags(sys.argv[1:] if arguments is None else arguments)
            call = parse(COMMANDS, current, prog="aero-viz", description=_DESCRIPTION)
            from aero_planner.warp_init import init_warp

            init_warp()
        call()
        sys.stdout.flush()
    except (UserError, ValueError) as error:
        if isinstance(error, ValueError) and os.environ.get("AERO_VIZ_DEBUG"):
            raise
        _refuse(str(error) if isinstance(error, UserError) else in_own_words(error), arguments)
        raise SystemExit(2) from None
    except BrokenPipeError:
        raise SystemExit(abandon_output()) from None
    except OSError as error:
        if os.environ.get("AERO_VIZ_DEBUG"):
            raise
        where = f"{error.filename}: " if error.filename else "the output cannot be written or read: "
        _refuse(f"{where}{error.strerror or error}.", arguments)
        with contextlib.suppress(OSError, ValueError):  # stdout without a file, as in a test
            abandon_output()
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        raise SystemExit(INTERRUPTED) from None
