"""Run a target of the Makefile at low priority beside a command: scripts/beside.py TARGET COMMAND [ARGUMENT ..].

The target uses the processor time that the command leaves. Its output is printed as a whole when it ends. The exit code
is that of the command, or else that of the target. Both end when this script is interrupted.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

# Where Linux weighs whole sessions against each other, niceness counts only within one.
START = '{ echo 19 >/proc/self/autogroup; } 2>/dev/null; exec nice -n19 make --no-print-directory "$1"'
"""Shell command that runs a target at the lowest priority."""


def main() -> int:
    """Run both and return the exit code."""
    target, *command = sys.argv[1:]
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    with tempfile.TemporaryFile() as log:
        beside = subprocess.Popen(
            ["sh", "-c", START, "sh", target], cwd=Path(__file__).parents[1],
            stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip
        printer = threading.Thread(target=print_when_ended, args=(beside, log.fileno()), daemon=True)
        printer.start()
        try:
            code = subprocess.call(command)
            printer.join()
        finally:
            if beside.poll() is None:
                os.killpg(beside.pid, signal.SIGTERM)
                beside.wait()
    return code or beside.returncode


def print_when_ended(process: subprocess.Popen[bytes], log: int) -> None:
    """Wait for a process and print what it has written to the file `log`."""
    process.wait()
    output = os.pread(log, os.fstat(log).st_size, 0).decode(errors="replace")
    print(output, end="", flush=True)


if __name__ == "__main__":
    sys.exit(main())
