"""Run targets at low priority beside a command: scripts/beside.py TARGET[,TARGET ..] COMMAND [ARGUMENT ..].

The targets run one after another and use the processor time that the command leaves. The output of each is printed as a
whole when it ends. After a command that fails, no further target is started. The exit code is that of the command, or
else that of the last target that failed. All end when this script is interrupted.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

# Where Linux weighs whole sessions against each other, niceness counts only within one.
START = """
trap stopped=1 USR1
{ echo 19 >/proc/self/autogroup; } 2>/dev/null
code=0
for target; do
    [ -z "$stopped" ] || break
    nice -n19 make --no-print-directory "$target" >"$OUTPUT" 2>&1 || code=$?
    cat "$OUTPUT"
done
exit $code
"""
"""Shell command that runs targets at the lowest priority, until SIGUSR1 makes the present one the last."""


def main() -> int:
    """Run both and return the exit code."""
    targets, *command = sys.argv[1:]
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    with tempfile.NamedTemporaryFile() as output:
        beside = subprocess.Popen(
            ["sh", "-c", START, "sh", *targets.split(",")], cwd=Path(__file__).parents[1],
            env=os.environ | {"OUTPUT": output.name}, stdin=subprocess.DEVNULL, start_new_session=True,
        )  # fmt: skip
        try:
            code = subprocess.call(command)
            if code:
                beside.send_signal(signal.SIGUSR1)
            code_beside = beside.wait()
        finally:
            if beside.poll() is None:
                os.killpg(beside.pid, signal.SIGTERM)
                beside.wait()
    return code or code_beside


if __name__ == "__main__":
    sys.exit(main())
