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
import mmap
import os
import select
import signal
import struct
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

from aero_planner.config import VehicleConfig
from aero_planner.onboard.braking_path import PATH_POINTS, BrakingPath
from aero_planner.onboard.connections import make_sender
from aero_planner.onboard.dead_reckoning import MotionState
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.stderr import log_to_stderr
from aero_planner.onboard.stop_controller import StopController
from aero_planner.onboard.transport import open_transport
from aero_planner.onboard.watchdog import UPCOMING_MAX, Heartbeat, Watchdog

__all__ = ["Failsafe", "FailsafeGuard", "FailsafeProcess", "HeartbeatMemory", "main", "takeover_time"]

_log = logging.getLogger(__name__)

_EXTRA_PERIODS = 2.0
"""Control periods by which the failsafe process waits longer than the watchdog, which acts first if it can."""


def takeover_time(onboard: OnboardConfig) -> float:
    """Return the time without a heartbeat after which the process brakes [s].

    Its first command follows within one control period.
    """
    return onboard.limits.deadline + _EXTRA_PERIODS / onboard.rates.control


class Failsafe(Protocol):
    """Something that brakes when the node falls silent although the drone obeys it, as seen by the node."""

    lost: bool
    """True if it has ended unexpectedly."""
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

    Raises:
        OSError: The process can't be started.

    Attributes:
        lost: True if the process has ended unexpectedly.
        interventions: Number of times that it braked.
    """

    def __init__(self, onboard: OnboardConfig, vehicle: VehicleConfig, find_peer: Callable[[], str | None]) -> None:
        self.lost = False
        self.interventions = 0
        self._find_peer = find_peer
        self._writing = threading.Lock()
        self._closed = False
        file = HeartbeatMemory.create_file()
        try:
            self._memory = HeartbeatMemory(file)
            self._process = subprocess.Popen(
                [sys.executable, "-m", "aero_planner.onboard.failsafe_process", str(file)],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                pass_fds=[file],
                # Ctrl-C and Ctrl-Z are meant for the node alone. NumPy needs only one thread for this work.
                start_new_session=True,
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
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
        while not self._memory.read_status().running:
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
                self._memory.write(heartbeat, self._find_peer())
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
        self.interventions = self._memory.read_status().interventions
        if not self.lost and self._process.poll() is not None:
            self.lost = True
            code = self._process.returncode
            _log.error("the failsafe process has ended with code %s: nothing brakes if this process dies", code)


# --- the shared memory ------------------------------------------------------------------------------------------------


class SharedHeartbeat(NamedTuple):
    """A heartbeat as read from the shared memory."""

    number: int
    """Counts the heartbeats from 1."""
    heartbeat: Heartbeat
    peer: str | None
    """Where commands go, in the form that `open_transport` takes; None while unknown."""


class ReaderStatus(NamedTuple):
    """What the reading process has reported."""

    running: bool
    braking: bool
    """True if the reader has braked since the newest heartbeat."""
    interventions: int
    """Number of times that the reader began to brake."""


class HeartbeatMemory:
    """The newest heartbeat, in memory shared by a writing and a reading process.

    Two slots are written in turn, each with a number and a checksum. If the writer is stopped in the middle of a slot,
    possibly for good, the previous heartbeat remains in the other slot.

    Args:
        file: Descriptor of the memory, from `create_file`. It may be closed afterwards.
    """

    _HEAD = struct.Struct("<Q256s")  # number, peer
    _UPCOMING = 20  # after time, motion with its control, and command
    _PATH = _UPCOMING + 4 * UPCOMING_MAX
    _NUMBERS = _PATH + 1 + 6 * PATH_POINTS  # with the upcoming commands and the path; NaN where there is none
    _SIZE = _HEAD.size + 8 * _NUMBERS + 4  # with the checksum
    _STATUS = struct.Struct("<QII")  # number of the heartbeat since which the reader brakes, running, interventions

    @classmethod
    def create_file(cls) -> int:
        """Create the memory and return its descriptor, which the caller owns."""
        file = os.memfd_create("aero-planner-heartbeat")
        os.ftruncate(file, 2 * cls._SIZE + cls._STATUS.size)
        return file

    def __init__(self, file: int) -> None:
        self._memory = mmap.mmap(file, 0)  # holds its own reference to the memory
        self._number = 0

    def write(self, heartbeat: Heartbeat, peer: str | None) -> None:
        """Replace the newest heartbeat. Only one thread may write at a time."""
        self._number += 1
        numbers = np.full(self._NUMBERS, math.nan)
        numbers[0] = heartbeat.time
        if heartbeat.motion is not None:
            motion = heartbeat.motion
            numbers[1:12] = motion.time, *motion.position, *motion.velocity, *motion.quaternion
            if motion.control is not None:
                numbers[12:16] = motion.control
        if heartbeat.command is not None:
            numbers[16:20] = heartbeat.command
        if heartbeat.upcoming is not None:
            upcoming = heartbeat.upcoming[:UPCOMING_MAX].ravel()
            numbers[self._UPCOMING : self._UPCOMING + len(upcoming)] = upcoming
        if heartbeat.path is not None:
            points = np.hstack([heartbeat.path.positions, heartbeat.path.velocities]).ravel()
            numbers[self._PATH] = heartbeat.path.period
            numbers[self._PATH + 1 : self._PATH + 1 + len(points)] = points
        data = self._HEAD.pack(self._number, (peer or "").encode()) + numbers.tobytes()
        start = self._number % 2 * self._SIZE
        self._memory[start : start + self._SIZE] = data + struct.pack("<I", zlib.crc32(data))

    def read(self) -> SharedHeartbeat | None:
        """Return the newest intact heartbeat, or None if there is none."""
        intact = [data for data in map(self._read_slot, (0, 1)) if data is not None]
        if not intact:
            return None
        data = max(intact, key=lambda data: self._HEAD.unpack_from(data)[0])
        number, peer = self._HEAD.unpack_from(data)
        numbers = np.frombuffer(data, np.float64, offset=self._HEAD.size)
        control = numbers[12:16] if np.isfinite(numbers[12:16]).all() else None
        motion = MotionState(float(numbers[1]), numbers[2:5], numbers[5:8], numbers[8:12], control)
        command, upcoming = numbers[16:20], numbers[self._UPCOMING : self._PATH].reshape(-1, 4)
        upcoming = upcoming[np.isfinite(upcoming).all(axis=1)]
        points = numbers[self._PATH + 1 :].reshape(-1, 6)
        points = points[np.isfinite(points).all(axis=1)]
        path = BrakingPath(float(numbers[self._PATH]), points[:, :3], points[:, 3:]) if len(points) > 1 else None
        heartbeat = Heartbeat(
            float(numbers[0]),
            motion if motion.is_finite else None,
            command if np.isfinite(command).all() else None,
            upcoming if len(upcoming) else None,
            path,
        )
        return SharedHeartbeat(number, heartbeat, peer.rstrip(b"\0").decode() or None)

    def write_status(self, braking_since: int = 0, interventions: int = 0) -> None:
        """Report, as the reader, that it is running.

        Args:
            braking_since: Number of the newest heartbeat if the reader has braked since; 0 if it has not.
            interventions: Number of times that the reader began to brake.
        """
        self._memory[2 * self._SIZE :] = self._STATUS.pack(braking_since, True, interventions)

    def read_status(self) -> ReaderStatus:
        """Return, to the writer, what the reader has reported."""
        braking_since, running, interventions = self._STATUS.unpack(self._memory[2 * self._SIZE :])
        return ReaderStatus(bool(running), 0 < braking_since == self._number, interventions)

    def _read_slot(self, slot: int) -> bytes | None:
        content = self._memory[slot * self._SIZE : (slot + 1) * self._SIZE]
        data, checksum = content[:-4], struct.unpack("<I", content[-4:])[0]
        return data if zlib.crc32(data) == checksum else None


# --- the failsafe process itself --------------------------------------------------------------------------------------


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
