"""The node as a process that the rig starts, stops, pauses and kills."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from aero_planner import PlannerConfig
from aero_planner.config.file import format_config
from aero_planner.import_path import child_environment, module_command
from aero_planner.onboard.flight_config import format_onboard
from aero_planner.onboard.settings import OnboardConfig

_NODE_COMMAND = module_command("aero_planner", "run", "--config", "{config}")  # as on the drone


class NodeProcess:
    """The node's process. It is not running until `start`.

    Args:
        planner, onboard: configuration of planner and node, which is written to a file.
        command: command to run instead of `aero-planner run`; "{config}" stands for the configuration file.
        patience: time that the process gets to end before it is killed [s].
    """

    def __init__(
        self,
        planner: PlannerConfig,
        onboard: OnboardConfig,
        *,
        command: Sequence[str] | None = None,
        patience: float = 10.0,
    ) -> None:
        self._patience = patience
        self._priority = os.getpriority(os.PRIO_PROCESS, 0)
        self._folder = tempfile.TemporaryDirectory(prefix="aero-rig-")
        config_file = Path(self._folder.name) / "flight.yaml"
        config_file.write_text(format_config(planner) + "\n" + format_onboard(onboard), encoding="utf-8")
        self._log_file = Path(self._folder.name) / "node.log"
        self._command = [part.replace("{config}", str(config_file)) for part in command or _NODE_COMMAND]
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start the process; it may be started again after it has ended."""
        environment = child_environment(PYTHONUNBUFFERED="1")
        with self._log_file.open("ab") as log:
            self._process = subprocess.Popen(
                self._command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, env=environment
            )
        with contextlib.suppress(OSError):  # the node must not inherit the raised priority of the simulation
            os.setpriority(os.PRIO_PROCESS, self._process.pid, self._priority)

    @property
    def running(self) -> bool:
        """True if the process was started and has not ended."""
        return self._process is not None and self._process.poll() is None

    def pause(self) -> None:
        """Stop the process until `resume`."""
        self._signal(signal.SIGSTOP)

    def resume(self) -> None:
        """Let a paused process continue."""
        self._signal(signal.SIGCONT)

    def kill(self) -> None:
        """End the process at once, as a loss of power would."""
        self._signal(signal.SIGKILL)
        if self._process is not None:
            self._process.wait()

    def log(self) -> list[str]:
        """Return the lines that the process has written so far."""
        with contextlib.suppress(OSError):
            return self._log_file.read_text(encoding="utf-8", errors="replace").splitlines()
        return []

    def stop(self) -> None:
        """Ask the process to end, and kill it if it does not."""
        if self._process is None or not self.running:
            return
        self.resume()
        self._signal(signal.SIGTERM)
        try:
            self._process.wait(self._patience)
        except subprocess.TimeoutExpired:
            self.kill()

    def close(self) -> None:
        """Stop the process and delete its files."""
        self.stop()
        self._folder.cleanup()

    def _signal(self, number: int) -> None:
        if self._process is not None and self.running:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._process.pid, number)


@contextlib.contextmanager
def raised_priority() -> Iterator[None]:
    """Give the simulation precedence over the node where permitted, because the real world does not wait either."""
    before = os.getpriority(os.PRIO_PROCESS, 0)
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, before - 10)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, 0, before)
