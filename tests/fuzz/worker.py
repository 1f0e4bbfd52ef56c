"""A child process that runs targets one after the other, with limits on memory and time."""

from __future__ import annotations

import contextlib
import io
import json
import logging
import os
import resource
import select
import subprocess
import sys
import time
import traceback
from dataclasses import astuple, dataclass
from pathlib import Path
from types import TracebackType

import psutil

SECONDS_MAX = 5.0
"""CPU time that a case may take [s]. A busy machine does not fail a case."""
MEMORY_MAX = 2 << 30
"""Memory that a case may take [bytes], the interpreter and its libraries included."""
_PATIENCE = 4 * SECONDS_MAX
"""CPU time after which a case that does not answer is ended [s] .."""
_PATIENCE_ASLEEP = 300.0
""".. and wall time, for a case that waits for something."""


@dataclass(frozen=True)
class Outcome:
    """The end of one case."""

    kind: str
    """"done", "refused", or a failure: "unnamed", "traceback", "memory", "slow", "hang", "crash"."""
    text: str = ""
    """Message of the refusal, or the traceback."""
    seconds: float = 0.0
    """CPU time [s]."""
    memory: int = 0
    """Peak memory [bytes]."""
    digest: str = ""
    """Checksum of what was read."""
    remarks: str = ""
    """Message to the user."""

    @property
    def is_failure(self) -> bool:
        """True unless the file was used or refused as promised."""
        return self.kind not in ("done", "refused")


class Worker:
    """The parent's side. A worker that ends is started again for the next case."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None

    def run(self, target: str, path: Path, *, seconds_max: float = SECONDS_MAX) -> Outcome:
        """Run a target on a file and return how it ended; a case that takes more CPU time [s] is slow."""
        process = self._process or self._start()
        assert process.stdin is not None and process.stdout is not None
        try:
            process.stdin.write(json.dumps([target, str(path), seconds_max]) + "\n")
            process.stdin.flush()
            has_answered = self._wait(process)
            line = process.stdout.readline() if has_answered else ""
        except BrokenPipeError:
            has_answered, line = True, ""
        if line:
            return Outcome(*json.loads(line))
        process.kill()
        code = process.wait()
        self.close()
        return Outcome("crash", f"the process ended with {code}") if has_answered else Outcome("hang")

    def _wait(self, process: subprocess.Popen[str]) -> bool:
        """Return True when the process answers or ends, False when its patience is over."""
        start, asleep_until = _tree_time(process.pid), time.monotonic() + _PATIENCE_ASLEEP
        assert process.stdout is not None
        while not select.select([process.stdout], [], [], 1.0)[0]:
            if _tree_time(process.pid) - start > _PATIENCE or time.monotonic() > asleep_until:
                return False
        return True

    def _start(self) -> subprocess.Popen[str]:
        folder = Path(__file__).parent
        path = os.pathsep.join([str(folder.parent), *sys.path])
        self._process = subprocess.Popen(
            [sys.executable, str(folder / "worker.py")],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
            env=os.environ | {"PYTHONPATH": path, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
        )  # fmt: skip
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == "ready\n", "the worker does not start"
        return self._process

    def close(self) -> None:
        """End the child."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            for pipe in (self._process.stdin, self._process.stdout):
                if pipe is not None:
                    pipe.close()
            self._process = None

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None):
        self.close()


def _status(key: str) -> int:
    """Return a value of /proc/self/status [bytes]."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(key + ":"):
            return int(line.split()[1]) * 1024
    raise LookupError(key)


def _tree_time(process: int) -> float:
    """Return the CPU time of a process and of those that it has started [s]."""
    total = 0.0
    with contextlib.suppress(psutil.NoSuchProcess):
        parent = psutil.Process(process)
        for member in (parent, *parent.children(recursive=True)):
            with contextlib.suppress(psutil.NoSuchProcess):
                times = member.cpu_times()
                total += times.user + times.system
    return total


def _cpu_time() -> float:
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def _is_out_of_memory(error: BaseException | None) -> bool:
    while error is not None:
        if isinstance(error, MemoryError):
            return True
        error = error.__cause__ or error.__context__
    return False


def _run(target: str, path: Path, seconds_max: float) -> Outcome:
    from fuzz.targets import TARGETS

    from aero_viz.errors import UserError

    Path("/proc/self/clear_refs").write_text("5")  # the peak counts from here
    start, reading, log = _cpu_time(), None, io.StringIO()
    handler = logging.StreamHandler(log)
    handler.setLevel(logging.WARNING)
    logging.getLogger().addHandler(handler)
    try:
        reading = TARGETS[target](path)
        kind, text = "done", ""
    except UserError as error:
        text = str(error)
        kind = "refused" if path.name in text and "\n" not in text and len(text) < 1000 else "unnamed"
        if _is_out_of_memory(error):
            kind = "memory"
    except MemoryError:
        kind, text = "memory", traceback.format_exc()
    except Exception:
        kind, text = "traceback", traceback.format_exc()
    finally:
        logging.getLogger().removeHandler(handler)
    seconds, memory = _cpu_time() - start, _status("VmHWM")
    if memory > MEMORY_MAX:
        kind, text = "memory", f"{memory >> 20} MiB; {text}"
    elif seconds > seconds_max and kind in ("done", "refused"):
        kind, text = "slow", f"{seconds:.1f} s; {text}"
    digest, remarks = ("", "") if reading is None else (reading.digest, reading.remarks)
    return Outcome(kind, text, round(seconds, 3), memory, digest, log.getvalue() + remarks)


def main() -> None:
    """Answer the lines of standard input, each a target and a path, with the outcomes."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # libraries print
    import fuzz.targets  # noqa: F401

    limit = _status("VmSize") - _status("VmRSS") + MEMORY_MAX
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    print("ready", file=answers, flush=True)
    for line in sys.stdin:
        target, path, seconds_max = json.loads(line)
        outcome = _run(target, Path(path), seconds_max)
        answers.write(json.dumps(astuple(outcome)) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
