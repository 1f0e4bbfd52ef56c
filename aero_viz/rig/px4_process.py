"""PX4's simulation (SITL) as a process, built by the user by PX4's own guide."""

from __future__ import annotations

import contextlib
import fcntl
import os
import signal
import socket
import subprocess
import tempfile
import time
from pathlib import Path

from aero_viz.errors import UserError
from aero_viz.rig.process import raised_priority

HOST = "127.0.0.1"

_BINARY = Path("build/px4_sitl_default/bin/px4")
_MODEL = "sihsim_quadx"  # PX4's "simulation in hardware", which needs no other simulator
_INSTANCES = 10  # with more, PX4's instances share ports
# Ports of instance 0, as PX4's startup script sets them; instance n adds n.
_COMPANION_PORT, _COMPANION_REMOTE, _STATION_PORT = 14580, 14540, 18570
_STOP_TIME = 5.0  # [s] that the process gets to end before it is killed


def find_px4(folder: str | Path) -> Path:
    """Return the path of the PX4 binary in a folder of PX4's sources, or of its build.

    Raises:
        UserError: there is none.
    """
    root = Path(folder)
    if not root.is_dir():
        raise UserError(f"{folder} is not a folder; --px4 needs that of PX4's sources, in which PX4 was built.")
    for binary in (root / _BINARY, root / "bin" / "px4"):
        if binary.is_file() and os.access(binary, os.X_OK) and (binary.parents[1] / "etc").is_dir():
            return binary.resolve()
    raise UserError(
        f"There is no {_BINARY} in {folder}: build PX4's simulation there by PX4's own guide (make px4_sitl_default)."
    )


class Px4Process:
    """A running PX4 with its own working folder, which is deleted with it.

    Args:
        folder: see `find_px4`.
        speed: simulated time per time that passes, at most. A slow PX4 can be stopped in time on a busy machine.

    Raises:
        UserError: there is no PX4, it was built for another computer, or all of its instances are in use.

    Attributes:
        system: MAVLink's system id of the vehicle.
        companion_port, companion_remote: UDP ports of PX4's connection to the onboard computer, and where it sends to.
        station_port: UDP port of its connection to a ground station.
        speed: simulated time per time that passes, at most.
    """

    def __init__(self, folder: str | Path, *, speed: float = 1.0) -> None:
        binary = find_px4(folder)
        instance = _free_instance()
        self.system = instance + 1
        self.companion_port, self.companion_remote = _COMPANION_PORT + instance, _COMPANION_REMOTE + instance
        self.station_port = _STATION_PORT + instance
        self.speed = speed
        self._paused = False
        self._temporary = tempfile.TemporaryDirectory(prefix="aero-px4-", ignore_cleanup_errors=True)
        self._folder = Path(self._temporary.name)
        self._output = self._folder / "px4.txt"
        self._kept: str | None = None
        environment = {name: value for name, value in os.environ.items() if not name.startswith("PX4_")}
        environment |= {"PX4_SIM_MODEL": _MODEL, "HEADLESS": "1"}
        if speed != 1.0:
            environment["PX4_SIM_SPEED_FACTOR"] = str(speed)
        command = [str(binary), "-d", "-i", str(instance), "-w", str(self._folder), str(binary.parents[1] / "etc")]
        try:
            with self._output.open("wb") as output, raised_priority():
                self._process = subprocess.Popen(
                    command, cwd=self._folder, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
                    env=environment,
                )  # fmt: skip
        except OSError as error:
            self._temporary.cleanup()
            raise UserError(f"{binary} cannot be started ({error.strerror}): build PX4 on this computer.") from error

    def clock(self) -> float:
        """Return a time that passes as fast as the simulated time may [s]."""
        return self.speed * time.monotonic()

    def check(self) -> None:
        """Raise UserError, see `failure`, if the process has ended."""
        code = self._process.poll()
        if code is not None:
            raise self.failure(f"PX4 has ended with exit code {code}")

    def failure(self, what: str) -> UserError:
        """Return an error that quotes the last line that PX4 has written, and names a copy of all of them.

        The copy stays: where PX4's start-up script fails, the reason is often far above the last line, and PX4 may run
        on without what the script should have started.
        """
        lines = self.log()
        if not lines:
            return UserError(f"{what}: it wrote nothing")
        if self._kept is None:
            with tempfile.NamedTemporaryFile("w", prefix="aero-px4-", suffix=".txt", delete=False) as file:
                file.write("\n".join([*lines, ""]))
            self._kept = file.name
        return UserError(f"{what}: {lines[-1]} (all that it wrote: {self._kept})")

    def log(self) -> list[str]:
        """Return the lines that PX4 has written so far."""
        text = self._output.read_text(encoding="utf-8", errors="replace")
        return [line for line in text.splitlines() if line.strip()]

    def pause(self) -> None:
        """Stop the process, and with it its simulated time, until `resume`."""
        if not self._paused:
            self._paused = True
            self._process.send_signal(signal.SIGSTOP)

    def resume(self) -> None:
        """Let a paused process continue where it was."""
        if self._paused:
            self._paused = False
            self._process.send_signal(signal.SIGCONT)

    def stop(self) -> Path | None:
        """End the process and return PX4's log of the flight (ULog), if there is one."""
        self.resume()
        if self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(_STOP_TIME)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        logs = sorted(self._folder.glob("log/**/*.ulg"), key=lambda path: path.stat().st_mtime)
        return logs[-1] if logs else None

    def close(self) -> None:
        """End the process and delete its files."""
        self.stop()
        self._temporary.cleanup()


def _free_instance() -> int:
    """Return the number of an instance of PX4 that is not running and whose ports are free."""
    for instance in range(_INSTANCES):
        ports = [_COMPANION_PORT + instance, _COMPANION_REMOTE + instance, _STATION_PORT + instance]
        if not _is_locked(instance) and all(map(_is_free, ports)):
            return instance
    raise UserError(f"All {_INSTANCES} instances of PX4 are in use; end one of them.")


def _is_locked(instance: int) -> bool:
    """Return True if the lock file of an instance is locked."""
    try:
        with open(f"/tmp/px4_lock-{instance}", "r+b") as lock:
            fcntl.lockf(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    return False


def _is_free(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, contextlib.suppress(OSError):
        probe.bind((HOST, port))
        return True
    return False
