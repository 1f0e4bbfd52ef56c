"""Shared memory between node and failsafe process: the node's newest heartbeat, and the reply."""

from __future__ import annotations

import math
import mmap
import os
import struct
import zlib
from typing import NamedTuple

import numpy as np

from aero_planner.onboard.braking_path import PATH_POINTS, BrakingPath
from aero_planner.onboard.dead_reckoning import MotionState
from aero_planner.onboard.watchdog import UPCOMING_MAX, Heartbeat


class SharedHeartbeat(NamedTuple):
    """A heartbeat as read from the shared memory."""

    number: int
    """Counts the heartbeats from 1."""
    heartbeat: Heartbeat
    peer: str | None
    """Destination of commands, in the form that `open_transport` takes; None while unknown."""
    signing_time: int = 0
    """Earliest time stamp of a signature that the autopilot accepts."""


class ReaderStatus(NamedTuple):
    """State that the reading process has reported."""

    steps: int
    """Number of steps that it has done; 0 before it runs."""
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

    Raises:
        ValueError: The memory was created by another version of this program.
    """

    _LAYOUT = struct.pack("<I", 6)  # to be increased with every change of what follows
    _HEAD = struct.Struct("<QQ256s")  # number, time stamp of signatures, peer
    _UPCOMING = 20  # after time, motion with its control, and command
    _PATH = _UPCOMING + 4 * UPCOMING_MAX
    _GAIN = _PATH + 1 + 6 * PATH_POINTS  # after the upcoming commands and the path, NaN where there is none
    _NUMBERS = _GAIN + 2  # and the floor
    _SIZE = _HEAD.size + 8 * _NUMBERS + 4  # with the checksum
    _STATUS = struct.Struct("<QII")  # number of the heartbeat since which the reader brakes, steps, interventions

    @classmethod
    def create_file(cls) -> int:
        """Create the memory and return its descriptor, which the caller owns."""
        file = os.memfd_create("aero-planner-heartbeat")
        os.write(file, bytes(2 * cls._SIZE + cls._STATUS.size) + cls._LAYOUT)
        return file

    def __init__(self, file: int) -> None:
        self._memory = mmap.mmap(file, 0)  # holds its own reference to the memory
        self._number = 0
        self._steps = 0
        if self._memory[2 * self._SIZE + self._STATUS.size :] != self._LAYOUT:
            raise ValueError("the heartbeat is from another version of aero-planner; start the node again.")

    def write(self, heartbeat: Heartbeat, peer: str | None, signing_time: int = 0) -> None:
        """Replace the newest heartbeat, see `SharedHeartbeat`. Only one thread may write at a time."""
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
        numbers[self._GAIN :] = heartbeat.thrust_gain, heartbeat.floor
        data = self._HEAD.pack(self._number, signing_time, (peer or "").encode()) + numbers.tobytes()
        start = self._number % 2 * self._SIZE
        self._memory[start : start + self._SIZE] = data + struct.pack("<I", zlib.crc32(data))

    def read(self) -> SharedHeartbeat | None:
        """Return the newest intact heartbeat, or None if there is none."""
        intact = [data for data in map(self._read_slot, (0, 1)) if data is not None]
        if not intact:
            return None
        data = max(intact, key=lambda data: self._HEAD.unpack_from(data)[0])
        number, signing_time, peer = self._HEAD.unpack_from(data)
        numbers = np.frombuffer(data, np.float64, offset=self._HEAD.size)
        control = numbers[12:16] if np.isfinite(numbers[12:16]).all() else None
        motion = MotionState(float(numbers[1]), numbers[2:5], numbers[5:8], numbers[8:12], control)
        command, upcoming = numbers[16:20], numbers[self._UPCOMING : self._PATH].reshape(-1, 4)
        upcoming = upcoming[np.isfinite(upcoming).all(axis=1)]
        points = numbers[self._PATH + 1 : self._GAIN].reshape(-1, 6)
        points = points[np.isfinite(points).all(axis=1)]
        path = BrakingPath(float(numbers[self._PATH]), points[:, :3], points[:, 3:]) if len(points) > 1 else None
        heartbeat = Heartbeat(
            float(numbers[0]),
            motion if motion.is_finite else None,
            command if np.isfinite(command).all() else None,
            upcoming if len(upcoming) else None,
            path,
            *numbers[self._GAIN :].tolist(),
        )
        return SharedHeartbeat(number, heartbeat, peer.rstrip(b"\0").decode() or None, signing_time)

    def write_status(self, braking_since: int = 0, interventions: int = 0) -> None:
        """Report, as the reader, one more step.

        Args:
            braking_since: Number of the newest heartbeat if the reader has braked since; 0 if it has not.
            interventions: Number of times that the reader began to brake.
        """
        self._steps = self._steps % 0xFFFFFFFF + 1
        self._STATUS.pack_into(self._memory, 2 * self._SIZE, braking_since, self._steps, interventions)

    def read_status(self) -> ReaderStatus:
        """Return, to the writer, the status that the reader has reported."""
        braking_since, steps, interventions = self._STATUS.unpack_from(self._memory, 2 * self._SIZE)
        return ReaderStatus(steps, 0 < braking_since == self._number, interventions)

    def _read_slot(self, slot: int) -> bytes | None:
        content = self._memory[slot * self._SIZE : (slot + 1) * self._SIZE]
        data, checksum = content[:-4], struct.unpack("<I", content[-4:])[0]
        return data if zlib.crc32(data) == checksum else None
