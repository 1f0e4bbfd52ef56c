"""Commands from any thread, which are run one at a time, between two ticks."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from typing import Any

from aero_viz.errors import UserError

USER_MISTAKES = (UserError, ValueError)
"""Errors of commands that need no traceback."""
_CLOSE_TIMEOUT = 10.0
"""Longest wait for a command that is running when the loop is closed [s]."""


class CommandLoop:
    """Runs commands in the order in which they are given, and other work when there are none.

    Until `start`, a command runs on the thread that gives it; while another thread is in `exclusive`, that thread runs
    it afterwards. From `start` on, a thread of the loop runs everything.

    Args:
        report: called with the error of a command.
        work: does the work besides commands.
        idle_time: returns the time until the thread must call `work` [s]; None if it need not.
        has_work: returns True if `work` must be called after a command even without a thread.
    """

    def __init__(
        self,
        *,
        report: Callable[[Exception], object],
        work: Callable[[], object],
        idle_time: Callable[[], float | None],
        has_work: Callable[[], bool],
    ) -> None:
        self._report, self._work, self._idle_time, self._has_work = report, work, idle_time, has_work
        self._waiting: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._closed = False
        self._thread: threading.Thread | None = None
        # Held by the thread that runs a command, until `start`.
        self._lock = threading.RLock()

    def put(self, command: Callable[[], Any], *, quiet: bool = False) -> Future[Any]:
        """Run `command` between two ticks, immediately if there is no thread and nobody is in `exclusive`.

        Returns:
            The future of its result, cancelled if the loop is closed. A quiet command does not report mistakes of the
            user.
        """
        future: Future[Any] = Future()

        def run() -> None:
            if self._closed:
                future.cancel()
            if not future.set_running_or_notify_cancel():
                return
            try:
                future.set_result(command())
            except Exception as error:
                future.set_exception(error)
                if not (quiet and isinstance(error, USER_MISTAKES)):
                    self._report(error)

        self._waiting.put(run)
        if self._closed:
            future.cancel()
        self._run_waiting()
        return future

    @contextmanager
    def exclusive(self) -> Iterator[None]:
        """Keep commands waiting, after those given before. They run at the end.

        Raises:
            RuntimeError: the loop has a thread, or it is closed.
        """
        try:
            with self._lock:
                if self._closed:
                    raise RuntimeError("the session is closed; create another one.")
                if self._thread is not None:
                    raise RuntimeError("the session was started and ticks by itself; use step(), play() and pause().")
                self._run_waiting()
                yield
        finally:
            self._run_waiting()

    def start(self, first: Callable[[], object], *, name: str) -> None:
        """Start the thread, which calls `first` before anything else.

        Raises:
            RuntimeError: it was started before, or the loop is closed.
        """
        with self._lock:
            if self._thread is not None or self._closed:
                raise RuntimeError(f"the session {'is closed' if self._closed else 'was already started'}.")
            self._thread = threading.Thread(target=self._run, args=(first,), name=name, daemon=True)
            self._thread.start()

    def close(self) -> bool:
        """Cancel the commands that wait and end the thread; return False if it is still busy after 10 s."""
        with self._lock:
            self._closed = True
        self._run_waiting()
        if self._thread is None:
            return True
        self._waiting.put(None)
        self._thread.join(_CLOSE_TIMEOUT)
        return not self._thread.is_alive()

    def _run(self, first: Callable[[], object]) -> None:
        first()
        while True:
            try:
                command = self._waiting.get(timeout=self._idle_time())
            except queue.Empty:
                self._work()
                continue
            if command is None:
                return
            command()

    def _run_waiting(self) -> None:
        """Run the commands that wait, unless there is a thread that does.

        If another thread is in `exclusive`, that thread runs them afterwards. Waiting for the lock instead could take
        long, since a loop of ticks hardly ever releases it.
        """
        while self._thread is None and not self._waiting.empty() and self._lock.acquire(blocking=False):
            try:
                while self._thread is None and not self._waiting.empty():
                    if (command := self._waiting.get()) is not None:
                        command()
                        while self._has_work() and not self._closed:
                            self._work()
            finally:
                self._lock.release()
