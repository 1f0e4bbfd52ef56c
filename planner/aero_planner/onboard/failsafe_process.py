"""A second process that brakes the drone when the node's process is stopped, killed, crashes or hangs as a whole.

It only reads the node's heartbeat from shared memory and runs a `Watchdog` that is slightly more patient than the
node's own. A pipe tells it when the node's process has ended; if the drone still obeyed the node, it then brakes at
once.

`FailsafeProcess` is the node's side. It starts the other side, `python -m aero_planner.onboard.failsafe_process`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import logging
import math
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Protocol

from aero_planner.config import VehicleConfig
from aero_planner.import_path import child_environment, module_command
from aero_planner.onboard.connections import make_sender
from aero_planner.onboard.heartbeat_memory import HeartbeatMemory
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.stderr import log_to_stderr
from aero_planner.onboard.stop_controller import StopController
from aero_planner.onboard.transport import open_transport
from aero_planner.onboard.watchdog import Heartbeat, Watchdog

_log = logging.getLogger(__name__)

_EXTRA_PERIODS = 2.0
"""Control periods by which the failsafe process waits longer than the watchdog, which acts first if it can."""


def takeover_time(onboard: OnboardConfig) -> float:
    """Return the time without a heartbeat after which the process brakes [s].

    Its first command follows within one control period.
    """
    return onboard.limits.deadline + _EXTRA_PERIODS / onboard.rates.control


_HANG_TIME = 0.5
"""Time without a step of the failsafe process after which it counts as hanging [s]. It does one per control period."""


class Failsafe(Protocol):
    """Something that brakes when the node falls silent although the drone obeys it, as seen by the node."""

    lost: bool
    """True if it has ended unexpectedly, or hangs."""
    interventions: int
    """Number of times that it braked."""

    @property
    def braking(self) -> bool:
        """True if it has braked since the newest heartbeat, so that the node does not know the last command."""
        ...

    def report(self, heartbeat: Heartbeat) -> None:
        """Pass on a heartbeat of the node. Never blocks; may be called from any thread."""
        ...

    def close(self) -> None:
        """End it without sending a command."""
        ...


class FailsafeProcess:
    """The node's handle of the process that brakes when the node falls silent although the drone obeys it.

    Args:
        onboard: Configuration of the node.
        vehicle: Configuration of the vehicle.
        find_peer: Returns where commands go, in the form that `open_transport` takes, or None while unknown.
        find_signing_time: Returns the earliest time stamp that the autopilot accepts, see `MavlinkSender`; None if
            messages are not signed.

    Raises:
        OSError: The process can't be started.

    Attributes:
        lost: True if the process has ended unexpectedly, or hangs.
        interventions: Number of times that it braked.
    """

    def __init__(
        self,
        onboard: OnboardConfig,
        vehicle: VehicleConfig,
        find_peer: Callable[[], str | None],
        find_signing_time: Callable[[], int] | None = None,
    ) -> None:
        self.lost = False
        self.interventions = 0
        self._has_ended = False
        self._steps, self._step_time = 0, math.inf
        self._find_peer = find_peer
        self._find_signing_time = find_signing_time
        self._writing = threading.Lock()
        self._closed = False
        file = HeartbeatMemory.create_file()
        try:
            self._memory = HeartbeatMemory(file)
            self._process = subprocess.Popen(
                module_command("aero_planner.onboard.failsafe_process", str(file)),
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                pass_fds=[file],
                # Ctrl-C and Ctrl-Z are meant for the node alone. NumPy needs only one thread for this work.
                start_new_session=True,
                env=child_environment(OPENBLAS_NUM_THREADS="1", OMP_NUM_THREADS="1"),
            )
        finally:
            os.close(file)
        settings = {"onboard": onboard.to_dict(), "vehicle": dataclasses.asdict(vehicle)}
        with contextlib.suppress(BrokenPipeError):
            assert self._process.stdin is not None
            self._process.stdin.write(json.dumps(settings).encode() + b"\n")
            self._process.stdin.flush()

    @property
    def pid(self) -> int:
        """Id of the process."""
        return self._process.pid

    @property
    def braking(self) -> bool:
        """True if it has braked since the newest heartbeat, so that this process does not know the last command."""
        return self._memory.read_status().braking

    def wait_until_running(self, timeout: float) -> None:
        """Wait until the process is ready to brake.

        Raises:
            OSError: It has ended, or is not ready after `timeout` [s].
        """
        end = time.monotonic() + timeout
        while not self._memory.read_status().steps:
            code = self._process.poll()
            if code is not None or time.monotonic() > end:
                problem = f"is not ready after {timeout:g} s" if code is None else f"has ended with code {code}"
                raise OSError(
                    f"the failsafe process, which brakes if this one dies, {problem}; see its messages above."
                )
            time.sleep(0.01)

    def report(self, heartbeat: Heartbeat) -> None:
        """Pass on a heartbeat of the node. Never blocks; may be called from any thread."""
        if not self._writing.acquire(blocking=False):
            return  # another thread is reporting at this moment
        try:
            if not self._closed:
                signing_time = 0 if self._find_signing_time is None else self._find_signing_time()
                self._memory.write(heartbeat, self._find_peer(), signing_time)
                self._update_status()
        finally:
            self._writing.release()

    def close(self) -> None:
        """End the process without sending a command."""
        with self._writing:
            if self._closed:
                return
            self._closed = True
            self._update_status()
        self._process.kill()
        self._process.wait()
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()

    def _update_status(self) -> None:
        status, now = self._memory.read_status(), time.monotonic()
        self.interventions = status.interventions
        if status.steps != self._steps:
            self._steps, self._step_time = status.steps, now
        if not self._has_ended and self._process.poll() is not None:
            self._has_ended = self.lost = True
            code = self._process.returncode
            _log.error("the failsafe process has ended with code %s: nothing brakes if this process dies", code)
        hangs = now - self._step_time > _HANG_TIME
        if not self._has_ended and hangs != self.lost:
            self.lost = hangs
            if hangs:
                _log.error("the failsafe process hangs: nothing brakes if this process dies")
            else:
                _log.warning("the failsafe process runs again")


# --- the failsafe process itself ---


class FailsafeGuard:
    """The work of the failsafe process, which does one step per control period.

    Args:
        memory: Heartbeats of the node.
        onboard: Configuration of the node.
        vehicle: Configuration of the vehicle.

    Raises:
        ImportError: pymavlink is not installed.
    """

    def __init__(self, memory: HeartbeatMemory, onboard: OnboardConfig, vehicle: VehicleConfig) -> None:
        self._memory = memory
        self._sender = make_sender(onboard, vehicle)
        self._watchdog = Watchdog(
            self._sender,
            StopController(vehicle, onboard.brake),
            vehicle,
            period=1.0 / onboard.rates.control,
            deadline=takeover_time(onboard),
            blind_time=onboard.limits.blind_time,
            response=onboard.response,
            name="failsafe process",
        )
        self._seen = 0
        self._peer: str | None = None
        memory.write_status()

    @property
    def needed(self) -> bool:
        """True if the drone obeys the node and has not yet been stopped and handed back."""
        return self._watchdog.needed

    def check(self, now: float, *, is_alone: bool) -> None:
        """Read the newest heartbeat, and send a command if the node does not.

        Args:
            now: Host time [s].
            is_alone: The node's process has ended.
        """
        newest = self._memory.read()
        if newest is not None and newest.number != self._seen:
            self._seen = newest.number
            if newest.peer is not None and newest.peer != self._peer:
                self._connect(newest.peer)
            self._sender.min_signing_time = newest.signing_time
            self._sender.thrust_gain = newest.heartbeat.thrust_gain
            self._watchdog.report(newest.heartbeat)
        if is_alone:
            self._watchdog.declare_dead(now)
        try:
            self._watchdog.check(now)
        except Exception:
            _log.exception("the failsafe process failed")
        self._memory.write_status(self._seen if self._watchdog.braking else 0, self._watchdog.interventions)

    def close(self) -> None:
        """Release the connection to the autopilot."""
        if self._sender.transport is not None:
            self._sender.transport.close()

    def _connect(self, peer: str) -> None:
        """Send commands to `peer` from now on, through this process's own connection."""
        self._peer = peer
        previous, self._sender.transport = self._sender.transport, None
        if previous is not None:
            previous.close()
        try:
            self._sender.transport = open_transport(peer, baud=None)
        except (OSError, ValueError) as error:
            _log.error("the failsafe process can't reach the autopilot at %s: %s", peer, error)


def main() -> None:
    """Watch over the process at the other end of standard input until it has ended and the drone is handed back."""
    # The node receives these signals, too. It stops the drone first and then ends this process.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    log_to_stderr()
    memory = HeartbeatMemory(int(sys.argv[1]))
    with open(0, "rb", buffering=0, closefd=False) as pipe:
        line = pipe.readline()
    if not line:
        return
    settings = json.loads(line)
    onboard = OnboardConfig.from_dict(settings["onboard"])
    guard = FailsafeGuard(memory, onboard, VehicleConfig(**settings["vehicle"]))
    is_alone, due, period = False, time.monotonic(), 1.0 / onboard.rates.control
    while not is_alone or guard.needed:
        wait = max(0.0, due - time.monotonic())
        if is_alone:
            time.sleep(wait)
        elif select.select([0], [], [], wait)[0]:
            is_alone = True  # the pipe is readable because its other end is closed
        now = time.monotonic()
        due = now + period
        guard.check(now, is_alone=is_alone)


if __name__ == "__main__":
    main()
