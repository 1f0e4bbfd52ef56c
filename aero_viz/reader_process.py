"""Runs functions that read files in a separate process, with limits on memory and time.

A reader disturbs nobody else then, and neither a crash nor an endless loop in a library ends the session.
"""

from __future__ import annotations

import contextlib
import math
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

from aero_planner.import_path import child_environment, module_command
from aero_planner.plain_text import in_own_words
from aero_planner.user_file import restrict_user_files, user_folders
from aero_viz.answers import encode, read_answer, write_answer
from aero_viz.errors import UserError
from aero_viz.input_limits import DECODER_MEMORY_BASE, DECODER_MEMORY_RATIO, TIME_BASE, TIME_PER_BYTE
from aero_viz.sandbox import confine

T = TypeVar("T")

_COUNT_BYTES = 8
_NICENESS = 10
_PATIENCE = 20  # wall time for a second of CPU time, on a busy machine
_SINGLE_THREAD = {
    # Threads of a library take memory, which is limited, and time from the session.
    "MALLOC_ARENA_MAX": "2", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "RAYON_NUM_THREADS": "2",
}  # fmt: skip


class Reader(Protocol):
    """Calls a function that reads a file, here or in another process."""

    def __call__(self, function: Callable[..., T], /, *arguments: Any, **options: Any) -> T:
        """Return the result of the function.

        Raises:
            UserError: the file cannot be read.
        """
        ...


def read_here(function: Callable[..., T], /, *arguments: Any, **options: Any) -> T:
    """Call the function in this process; a `Reader`."""
    return function(*arguments, **options)


class ReadCancelled(UserError):
    """Somebody cancelled the reading."""


@dataclass(frozen=True)
class Limits:
    """Limits of one call."""

    memory: int = 2_000_000_000
    """Memory of the process [bytes]."""
    seconds: float = 300.0
    """Time [s]."""
    cpu_seconds: float = math.inf
    """CPU time [s]."""

    @classmethod
    def for_file(cls, size: int) -> Limits:
        """Return the limits of decoding a file of `size` bytes."""
        cpu_seconds = math.ceil(TIME_BASE + TIME_PER_BYTE * size)
        return cls(DECODER_MEMORY_BASE + DECODER_MEMORY_RATIO * size, _PATIENCE * (cpu_seconds + 10), cpu_seconds)


class ReaderProcess:
    """A `Reader` whose calls run in a separate process, with a lower priority than this one.

    The function and its arguments are pickled; the result is data, see `aero_viz.answers`.

    Args:
        limits: what a call may use; on Windows, only the time is limited.
        is_kept: True keeps the process for further calls, until `close`, and forbids functions that start processes.
            Otherwise every call starts one.
        folders: the only folders in which the process opens files that a user names; None leaves it to what holds here.
    """

    def __init__(
        self, limits: Limits = Limits(), *, is_kept: bool = False, folders: Iterable[str | Path] | None = None
    ) -> None:
        self._limits = limits
        self._is_kept = is_kept
        self._folders = folders if folders is None else tuple(map(str, folders))
        self._process: subprocess.Popen[bytes] | None = None
        self._started = time.monotonic()
        self._first_bytes = 0
        """Bytes that the process had read before the call, for its imports; 0 if that is not known."""
        self._verdict: UserError | None = None
        """Reason for which the process was ended."""
        self._lock = threading.Lock()

    def __call__(self, function: Callable[..., T], /, *arguments: Any, **options: Any) -> T:
        """Return the result of the function.

        Raises:
            UserError: the function raised an error, exceeded a limit, or crashed.
            ReadCancelled: `cancel` was called.
        """
        return self.call(self._limits, function, *arguments, **options)

    def call(self, limits: Limits, function: Callable[..., T], /, *arguments: Any, **options: Any) -> T:
        """Return the result of the function, called within `limits` instead of those of the process.

        Raises:
            UserError, ReadCancelled: as for `__call__`.
        """
        process = self._start()
        too_long = UserError(f"Reading it takes longer than {limits.seconds:g} s.")
        timer = threading.Timer(limits.seconds, self._end, [too_long])
        timer.daemon = True
        timer.start()
        answer = None
        try:
            folders = user_folders() if self._folders is None else self._folders
            answer = self._exchange(process, pickle.dumps((limits, folders, function, arguments, options)), limits)
        finally:
            timer.cancel()
            if answer is None or not self._is_kept:
                self.close()
        verdict = self._verdict
        if verdict is not None:
            if self._is_kept and not isinstance(verdict, ReadCancelled):
                self._verdict = None  # the next call starts a process
            raise verdict
        if answer is None:
            if process.returncode == -getattr(signal, "SIGXCPU", math.inf):
                raise UserError(f"Reading it takes more than {limits.cpu_seconds:g} s of CPU time.")
            raise UserError(
                f"The process that read it ended with code {process.returncode}; the file is probably damaged."
            )
        kind, content = answer
        if kind == "error":
            raise UserError(content)
        if kind == "memory":
            raise UserError(f"It needs more than {limits.memory / 1e9:.3g} GB of memory.")
        return content

    @property
    def progress(self) -> str:
        """Progress so far, such as "120 MB, 3 s"."""
        seconds = f"{time.monotonic() - self._started:.0f} s"
        process, first = self._process, self._first_bytes
        if process is None or not first:
            return seconds
        megabytes = round(1e-6 * (_bytes_read(process.pid) - first))
        return f"{megabytes} MB, {seconds}" if megabytes > 0 else seconds

    def cancel(self) -> None:
        """End the reading; the call raises `ReadCancelled`."""
        self._end(ReadCancelled("It was cancelled."))

    @property
    def is_cancelled(self) -> bool:
        """True once `cancel` was called, unless the reading had failed before."""
        return isinstance(self._verdict, ReadCancelled)

    def close(self) -> None:
        """End the process."""
        with self._lock:
            process, self._process = self._process, None
        if process is not None:
            _kill(process)
            process.wait()
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    with contextlib.suppress(BrokenPipeError):
                        pipe.close()

    def _start(self) -> subprocess.Popen[bytes]:
        with self._lock:
            if self._verdict is not None:
                raise self._verdict
            if self._process is None:
                # A kept process stays in the group of this one: it ends with it, also if that is itself a reader.
                self._process = subprocess.Popen(
                    module_command(__name__), stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                    stderr=subprocess.DEVNULL, env=child_environment(**_SINGLE_THREAD),
                    start_new_session=not self._is_kept,
                )  # fmt: skip
            return self._process

    def _exchange(self, process: subprocess.Popen[bytes], request: bytes, limits: Limits) -> tuple[str, Any] | None:
        """Return the answer, None if the process ended without one."""
        assert process.stdin is not None and process.stdout is not None
        try:
            process.stdin.write(request)
            process.stdin.flush()
            self._first_bytes = int.from_bytes(process.stdout.read(_COUNT_BYTES), "little")
            kind, content = read_answer(process.stdout, limits.memory)
            if kind in ("result", "error", "memory"):
                return kind, content
            raise ValueError(f"an answer of the kind {kind!r}")
        except (BrokenPipeError, EOFError):
            pass
        except (TypeError, ValueError):  # the file has taken over the process
            self._end(UserError("The process that read it gave no proper answer; the file is probably hostile."))
        process.wait()
        return None

    def _end(self, verdict: UserError) -> None:
        with self._lock:
            self._verdict = self._verdict or verdict
            if self._process is not None:
                _kill(self._process)


def _bytes_read(process: int) -> int:
    """Return how much a process has read from files, 0 where the system does not say."""
    try:
        lines = Path(f"/proc/{process}/io").read_text().splitlines()
        return int(dict(line.split(": ") for line in lines)["rchar"])
    except (OSError, KeyError, ValueError):
        return 0


def _kill(process: subprocess.Popen[bytes]) -> None:
    """End a process and, if it leads a group, those that it has started."""
    if process.returncode is not None:
        return
    with contextlib.suppress(ProcessLookupError):
        if os.name == "posix" and os.getpgid(process.pid) == process.pid:
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()


def _limit_resources(limits: Limits) -> None:
    """Limit this process for the next call; the parent may be gone before it ends."""
    if os.name != "posix":
        return
    import resource

    usage = resource.getrusage(resource.RUSAGE_SELF)
    values = {resource.RLIMIT_DATA: limits.memory, resource.RLIMIT_FSIZE: limits.memory, resource.RLIMIT_CORE: 0}
    if math.isfinite(limits.cpu_seconds):
        values[resource.RLIMIT_CPU] = math.ceil(usage.ru_utime + usage.ru_stime + limits.cpu_seconds)
    for kind, value in values.items():
        hard = resource.getrlimit(kind)[1]
        resource.setrlimit(kind, (value if hard == resource.RLIM_INFINITY else min(value, hard), hard))
    signal.alarm(math.ceil(limits.seconds) + 1)


def _answer(request: tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any]]) -> bytes:
    """Call a function, and return its encoded result or error."""
    function, arguments, options = request
    try:
        return encode(("result", function(*arguments, **options)))
    except UserError as error:
        return encode(("error", str(error)))
    except MemoryError:
        return encode(("memory", None))
    except Exception as error:
        return encode(("error", in_own_words(error)))


def _lower_priority() -> None:
    """Run this process behind the one that started it, also if that has a real-time priority, which is inherited."""
    if os.name != "posix":
        return
    if sys.platform == "linux":
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        # Where Linux weighs whole sessions against each other, niceness counts only within one.
        if os.getsid(0) == os.getpid():
            with contextlib.suppress(OSError):
                Path("/proc/self/autogroup").write_text(str(_NICENESS))
    os.nice(_NICENESS)


def _serve() -> None:
    """Answer the requests on stdin on stdout, one after the other."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # whatever a library prints is no answer
    _lower_priority()
    confined_to: set[tuple[str, ...] | None] = set()
    while True:
        try:
            limits, folders, *request = pickle.load(sys.stdin.buffer)
        except EOFError:
            os._exit(0)  # the threads of a library must not hold up the end
        _limit_resources(limits)
        restrict_user_files(folders)
        if folders not in confined_to:
            confine(folders)
            confined_to.add(folders)
        answers.write(_bytes_read(os.getpid()).to_bytes(_COUNT_BYTES, "little"))
        answers.flush()
        write_answer(answers, _answer((request[0], request[1], request[2])))
        if os.name == "posix":
            signal.alarm(0)


if __name__ == "__main__":
    _serve()
