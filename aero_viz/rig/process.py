"""The node in a process of its own: started, stopped, paused, killed, and listened to."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from aero_planner import PlannerConfig
from aero_planner.config.file import format_config
from aero_planner.onboard.settings import OnboardConfig, format_onboard

__all__ = ["NodeProcess", "run_command"]


def run_command(config: Path) -> list[str]:
    """Return the command line that flies with the configuration in a file, as on the drone."""
    return [sys.executable, "-m", "aero_planner", "run", "--config", str(config)]


class NodeProcess:
    """A process that is told to fly.

    Args:
        planner, onboard: its configuration, written to a file.
        command: what to run in the place of `aero-planner run`; "{config}" stands for that file.
        patience: with a process that was told to end [s].
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
        config = Path(self._folder.name) / "flight.yaml"
        config.write_text(format_config(planner) + "\n" + format_onboard(onboard), encoding="utf-8")
        self._log = Path(self._folder.name) / "node.log"
        self._command = [part.replace("{config}", str(config)) for part in command or run_command(config)]
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start it, again if need be."""
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                self._command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, env=self._environment()
            )
        with contextlib.suppress(OSError):  # not the simulation's, see `rig`
            os.setpriority(os.PRIO_PROCESS, self._process.pid, self._priority)

    @property
    def running(self) -> bool:
        """Whether it was started and has not ended."""
        return self._process is not None and self._process.poll() is None

    def pause(self) -> None:
        """Stop its time."""
        self._signal(signal.SIGSTOP)

    def resume(self) -> None:
        """Let its time go on."""
        self._signal(signal.SIGCONT)

    def kill(self) -> None:
        """End it at once, as a loss of power would."""
        self._signal(signal.SIGKILL)
        if self._process is not None:
            self._process.wait()

    def log(self) -> list[str]:
        """Return what it has written so far, line by line."""
        with contextlib.suppress(OSError):
            return self._log.read_text(encoding="utf-8", errors="replace").splitlines()
        return []

    def stop(self) -> None:
        """Tell it to end, and end it if it does not."""
        if self.running:
            self.resume()
            self._signal(signal.SIGTERM)
            assert self._process is not None
            try:
                self._process.wait(self._patience)
            except subprocess.TimeoutExpired:
                self.kill()

    def close(self) -> None:
        """Stop it and remove its files."""
        self.stop()
        self._folder.cleanup()

    def _signal(self, number: int) -> None:
        if self.running:
            assert self._process is not None
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._process.pid, number)

    def _environment(self) -> dict[str, str]:
        return {**os.environ, "PYTHONUNBUFFERED": "1"}
