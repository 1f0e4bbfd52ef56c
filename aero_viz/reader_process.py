"""Reads a file in a process of its own, with limits on memory and time, so that the reader disturbs nobody else."""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

from aero_viz.errors import UserError

__all__ = ["Limits", "ReadCancelled", "Reader", "ReaderProcess", "read_here"]

T = TypeVar("T")

_STARTED = b"s"
_NICENESS = 10


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
    """What one reading may use."""

    memory: int = 2_000_000_000
    """Memory of the process [bytes]."""
    seconds: float = 300.0
    """Time [s]."""


class ReaderProcess:
    """A `Reader` that starts a process for one call.

    The function, its arguments and its result are pickled. The process has a lower priority than this one.

    Args:
        limits: what the process may use; on Windows, only the time is limited.
    """

    def __init__(self, limits: Limits = Limits()) -> None:
        self._limits = limits
        self._process: subprocess.Popen[bytes] | None = None
        self._started = time.monotonic()
        self._first_bytes: int | None = None
        """Bytes that the process had read before the call, for its imports."""
        self._verdict: UserError | None = None
        """Why the process was ended."""
        self._lock = threading.Lock()

    def __call__(self, function: Callable[..., T], /, *arguments: Any, **options: Any) -> T:
        """Return the result of the function.

        Raises:
            UserError: the function raised an error, exceeded a limit, or crashed.
            ReadCancelled: `cancel` was called.
        """
        process = self._start()
        timer = threading.Timer(self._limits.seconds, self._end, [self._too_long()])
        timer.daemon = True
        timer.start()
        try:
            answer = self._exchange(process, pickle.dumps((function, arguments, options)))
        finally:
            timer.cancel()
            _kill(process)
            process.wait()
        if self._verdict is not None:
            raise self._verdict
        if not answer:
            code = process.returncode
            raise UserError(f"The process that read it ended with code {code}; the file is probably damaged.")
        kind, content = pickle.loads(answer)
        if kind == "error":
            raise UserError(content)
        if kind == "memory":
            raise UserError(f"It needs more than {self._limits.memory / 1e9:.3g} GB of memory.")
        return content

    @property
    def progress(self) -> str:
        """What has been done so far, such as "120 MB, 3 s"."""
        seconds = f"{time.monotonic() - self._started:.0f} s"
        now, first = self._bytes_read(), self._first_bytes
        return seconds if now is None or first is None else f"{(now - first) / 1e6:.0f} MB, {seconds}"

    def cancel(self) -> None:
        """End the reading; the call raises `ReadCancelled`."""
        self._end(ReadCancelled("It was cancelled."))

    def _start(self) -> subprocess.Popen[bytes]:
        limits = (str(self._limits.memory), str(self._limits.seconds))
        # The process has to find the same modules, also those of a script's folder.
        path = os.pathsep.join(folder or os.getcwd() for folder in sys.path)
        with self._lock:
            if self._verdict is not None:
                raise self._verdict
            self._process = subprocess.Popen(
                [sys.executable, "-m", __name__, *limits], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL, env={**os.environ, "PYTHONPATH": path}, start_new_session=True,
            )  # fmt: skip
            return self._process

    def _exchange(self, process: subprocess.Popen[bytes], request: bytes) -> bytes:
        """Return the pickled answer, empty if the process ended without one."""
        assert process.stdin is not None and process.stdout is not None
        try:
            with process.stdin, process.stdout:
                process.stdin.write(request)
                process.stdin.close()
                if process.stdout.read(1) != _STARTED:
                    return b""
                self._first_bytes = self._bytes_read()
                answer = process.stdout.read()
        except BrokenPipeError:
            answer = b""
        process.wait()
        return answer if process.returncode == 0 else b""

    def _end(self, verdict: UserError) -> None:
        with self._lock:
            self._verdict = self._verdict or verdict
            if self._process is not None:
                _kill(self._process)

    def _too_long(self) -> UserError:
        return UserError(f"Reading it takes longer than {self._limits.seconds:g} s.")

    def _bytes_read(self) -> int | None:
        """Return how much the process has read from files, None where the system does not say."""
        if self._process is None:
            return None
        try:
            lines = Path(f"/proc/{self._process.pid}/io").read_text().splitlines()
            return int(dict(line.split(": ") for line in lines)["rchar"])
        except (OSError, KeyError, ValueError):
            return None


def _kill(process: subprocess.Popen[bytes]) -> None:
    """End a process and those that it has started."""
    if process.returncode is not None:
        return
    if os.name == "posix":
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    else:
        process.kill()


def _limit_resources(memory: int, seconds: float) -> None:
    """Limit this process; the parent may be gone before it ends."""
    if os.name != "posix":
        return
    import resource

    os.nice(_NICENESS)
    resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
    resource.setrlimit(resource.RLIMIT_FSIZE, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.alarm(round(seconds) + 1)


def _serve() -> None:
    """Answer one request from stdin on stdout."""
    answer = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # whatever a library prints is no answer
    _limit_resources(int(sys.argv[1]), float(sys.argv[2]))
    function, arguments, options = pickle.load(sys.stdin.buffer)
    answer.write(_STARTED)
    answer.flush()
    try:
        content = pickle.dumps(("result", function(*arguments, **options)), protocol=pickle.HIGHEST_PROTOCOL)
    except UserError as error:
        content = pickle.dumps(("error", str(error)))
    except MemoryError:
        content = pickle.dumps(("memory", None))
    except Exception as error:
        content = pickle.dumps(("error", f"{type(error).__name__}: {error}"))
    answer.write(content)
    answer.flush()
    os._exit(0)  # the threads of a library must not hold up the end


if __name__ == "__main__":
    _serve()
