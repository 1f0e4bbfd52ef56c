"""What brakes the drone when the node's whole process does not: stopped, killed, crashed, or hanging as a whole.

The guard is a process of its own. It does nothing but read, from memory that both share, the beats of the node, and
watch over them with a `Watchdog` like the node's own, which is a little less patient. A pipe tells it that the node's
process is gone: a node that was obeyed until then is replaced at once.

The node's side is `FailsafeProcess`; it starts the other one,
`python -m aero_planner.onboard.failsafe_process`.
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

import numpy as np

from aero_planner.config import VehicleConfig
from aero_planner.onboard.connections import make_sender
from aero_planner.onboard.dead_reckoning import MotionState, StopController
from aero_planner.onboard.mavlink import MavlinkSender
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.stderr import log_to_stderr
from aero_planner.onboard.transport import open_transport
from aero_planner.onboard.watchdog import AHEAD, Heartbeat, Watchdog

__all__ = ["FailsafeProcess", "HeartbeatMemory", "main", "takeover_time"]

_log = logging.getLogger(__name__)

_EXTRA_PERIODS = 2.0
"""Of the control loop, by which the guard is more patient than the watchdog, which goes first if it can."""


def takeover_time(onboard: OnboardConfig) -> float:
    """Return the time without a beat after which the guard brakes [s]; its command follows within a control period."""
    return onboard.limits.deadline + _EXTRA_PERIODS / onboard.rates.control


# --- what both share --------------------------------------------------------------------------------------------------


class HeartbeatMemory:
    """The newest beat, in memory that a writing and a reading process share.

    Two slots are written in turn, each with a count and a checksum. Whoever is stopped in the middle of a slot, perhaps
    for good, leaves the beat before in the other one.

    Args:
        file: descriptor of the memory, from `new_file`; it may be closed then.
    """

    _HEAD = struct.Struct("<Q256s")  # count, target
    _NUMBERS = 16 + 4 * AHEAD  # time, motion, command, commands ahead; NaN for what is not there
    _SIZE = _HEAD.size + 8 * _NUMBERS + 4  # with the checksum
    _REPORT = struct.Struct("<QII")  # count of the beat after which the reader brakes, whether at work, interventions

    @classmethod
    def new_file(cls) -> int:
        """Return the descriptor of new memory, the caller's."""
        file = os.memfd_create("aero-planner-beats")
        os.ftruncate(file, 2 * cls._SIZE + cls._REPORT.size)
        return file

    def __init__(self, file: int) -> None:
        self._memory = mmap.mmap(file, 0)  # which holds on to it by itself
        self._count = 0

    def write(self, beat: Heartbeat, target: str | None) -> None:
        """Replace the newest beat; `target` is where commands go, as `open_transport` takes it."""
        self._count += 1
        numbers = np.full(self._NUMBERS, math.nan)
        numbers[0] = beat.time
        if beat.motion is not None:
            motion = beat.motion
            numbers[1:12] = motion.time, *motion.position, *motion.velocity, *motion.quaternion
        if beat.command is not None:
            numbers[12:16] = beat.command
        if beat.ahead is not None:
            ahead = beat.ahead[:AHEAD].ravel()
            numbers[16 : 16 + len(ahead)] = ahead
        data = self._HEAD.pack(self._count, (target or "").encode()) + numbers.tobytes()
        start = self._count % 2 * self._SIZE
        self._memory[start : start + self._SIZE] = data + struct.pack("<I", zlib.crc32(data))

    def read(self) -> tuple[int, Heartbeat, str | None] | None:
        """Return the count of the newest whole beat, the beat and its target; None when there is none."""
        whole = [data for data in map(self._get, (0, 1)) if data is not None]
        if not whole:
            return None
        data = max(whole, key=lambda data: self._HEAD.unpack_from(data)[0])
        count, target = self._HEAD.unpack_from(data)
        numbers = np.frombuffer(data, np.float64, offset=self._HEAD.size)
        motion = MotionState(float(numbers[1]), numbers[2:5], numbers[5:8], numbers[8:12])
        command, ahead = numbers[12:16], numbers[16:].reshape(-1, 4)
        ahead = ahead[np.isfinite(ahead).all(axis=1)]
        beat = Heartbeat(
            float(numbers[0]),
            motion if motion.finite else None,
            command if np.isfinite(command).all() else None,
            ahead if len(ahead) else None,
        )
        return count, beat, target.rstrip(b"\0").decode() or None

    def report(self, braking_since: int = 0, interventions: int = 0) -> None:
        """Say, as the reader, that it is at work.

        Args:
            braking_since: count of the newest beat if the reader has braked since; 0 if it has not.
            interventions: times that it began to.
        """
        self._memory[2 * self._SIZE :] = self._REPORT.pack(braking_since, True, interventions)

    def reported(self) -> tuple[bool, bool, int]:
        """Return whether the reader is at work, whether it has braked since the newest beat, and how often it began."""
        braking_since, ready, interventions = self._REPORT.unpack(self._memory[2 * self._SIZE :])
        return bool(ready), 0 < braking_since == self._count, interventions

    def _get(self, slot: int) -> bytes | None:
        whole = self._memory[slot * self._SIZE : (slot + 1) * self._SIZE]
        data, checksum = whole[:-4], struct.unpack("<I", whole[-4:])[0]
        return data if zlib.crc32(data) == checksum else None


# --- the node's side --------------------------------------------------------------------------------------------------


class FailsafeProcess:
    """A process that streams the braking command when this one falls silent although the drone obeys it.

    Args:
        onboard, vehicle: as the node's.
        partner: returns where commands go, as `open_transport` takes it; None while it is not known.

    Raises:
        OSError: the process can't be started.
    """

    def __init__(self, onboard: OnboardConfig, vehicle: VehicleConfig, partner: Callable[[], str | None]) -> None:
        self._partner = partner
        self._writing = threading.Lock()
        self._closed = False
        self.lost = False
        """Whether it has ended although it should not have."""
        self.interventions = 0
        """Times that it had to brake."""
        file = HeartbeatMemory.new_file()
        try:
            self._memory = HeartbeatMemory(file)
            self._process = subprocess.Popen(
                [sys.executable, "-m", "aero_planner.onboard.failsafe_process", str(file)],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                pass_fds=[file],
                # Ctrl-C and Ctrl-Z are for the node alone; one thread is enough for what NumPy has to do.
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
    def braking(self) -> bool:
        """Whether it has braked since the newest beat, so that nobody here knows what the drone was told last."""
        return self._memory.reported()[1]

    def wait(self, timeout: float) -> None:
        """Wait until it is at work.

        Raises:
            OSError: it has ended, or is not at work after `timeout` [s].
        """
        end = time.monotonic() + timeout
        while not self._memory.reported()[0]:
            code = self._process.poll()
            if code is not None or time.monotonic() > end:
                how = f"is not at work after {timeout:g} s" if code is None else f"has ended with code {code}"
                raise OSError(f"the guard, the process that brakes when this one dies, {how}; see what it wrote above.")
            time.sleep(0.01)

    def beat(self, beat: Heartbeat) -> None:
        """Say that this process is there. Never blocks; any thread may call."""
        if not self._writing.acquire(blocking=False):
            return  # another thread says so
        try:
            if not self._closed:
                self._memory.write(beat, self._partner())
                self._look_after()
        finally:
            self._writing.release()

    def close(self) -> None:
        """End it, without a command."""
        with self._writing:
            if self._closed:
                return
            self._closed = True
            self._look_after()
        self._process.kill()
        self._process.wait()
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()

    def _look_after(self) -> None:
        self.interventions = self._memory.reported()[2]
        if not self.lost and self._process.poll() is not None:
            self.lost = True
            code = self._process.returncode
            _log.error("the guard has ended with code %s: nobody brakes if this process dies", code)


# --- the guard's side -------------------------------------------------------------------------------------------------


def main() -> None:
    """Guard the process at the other end of the standard input, until that has ended and the drone is not ours."""
    # The node is told to end, and brings the drone to rest first; the guard ends with it.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    log_to_stderr()
    memory = HeartbeatMemory(int(sys.argv[1]))
    with open(0, "rb", buffering=0, closefd=False) as pipe:
        line = pipe.readline()
    if not line:
        return
    settings = json.loads(line)
    onboard = OnboardConfig().replace(
        {
            f"{section}.{name}": value
            for section, values in settings["onboard"].items()
            for name, value in values.items()
        }
    )
    vehicle = VehicleConfig(**settings["vehicle"])
    sender = make_sender(onboard, vehicle)
    watchdog = Watchdog(
        sender,
        StopController(vehicle, onboard.brake),
        vehicle,
        period=1.0 / onboard.rates.control,
        deadline=takeover_time(onboard),
        blind_time=onboard.limits.blind_time,
        name="guard",
    )
    memory.report()
    _watch(memory, sender, watchdog, 1.0 / onboard.rates.control)


def _watch(memory: HeartbeatMemory, sender: MavlinkSender, watchdog: Watchdog, period: float) -> None:
    """Pass beats on to the watchdog, once per period, until the process at the other end of the pipe has ended."""
    seen, target, alone = 0, None, False
    due = time.monotonic()
    while not alone or watchdog.needed:
        wait = max(0.0, due - time.monotonic())
        if alone:
            time.sleep(wait)
        elif select.select([0], [], [], wait)[0]:
            alone = True  # the pipe has no other end any more
        now = time.monotonic()
        due = now + period
        newest = memory.read()
        if newest is not None and newest[0] != seen:
            seen, beat, partner = newest
            if partner is not None and partner != target:
                target = partner
                _point(sender, target)
            watchdog.beat(beat)
        if alone:
            watchdog.give_up(now)
        try:
            watchdog.check(now)
        except Exception:
            _log.exception("the guard failed")
        memory.report(seen if watchdog.braking else 0, watchdog.interventions)


def _point(sender: MavlinkSender, target: str) -> None:
    """Let commands go to `target`, through a connection of our own."""
    before, sender.port = sender.port, None
    if before is not None:
        before.close()
    try:
        sender.port = open_transport(target, baud=None)
    except (OSError, ValueError) as error:
        _log.error("the guard can't reach the autopilot at %s: %s", target, error)


if __name__ == "__main__":
    main()
