"""The flight log: an MCAP file, written in chunks while flying, so that a crash costs the last second at most."""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import logging
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from aero_planner import VehicleState
from aero_planner.config.file import format_config
from aero_planner.onboard.ros_messages import DEFINITIONS, Encoded, pose_messages
from aero_viz.errors import UserError
from aero_viz.logs.messages import body_rates, encode_goal, encode_plan, encode_sweep
from aero_viz.session import Session
from aero_viz.session.frame import Frame
from aero_viz.session.sinks import Sink
from aero_viz.session.source import SourceInfo

__all__ = ["FlightLog", "flight_recorder", "new_points", "record"]

_log = logging.getLogger(__name__)

_CHUNK_BYTES = 1 << 20
_FLUSH_PERIOD = 1.0  # of wall time [s]: a killed process loses no more than this
_SWEEP_STEP = 1000  # between the sweeps of a cloud that is logged whole [ns]
_PATIENCE = 10.0  # with a disk that is behind at the end [s]


class FlightLog:
    """Writes frames to an MCAP file with the messages of the drone's own log.

    Attachments hold each configuration, and for each source its world and settings: world.json and flight.json of the
    first, world_1.json and flight_1.json of the next. The goal is written at the start and whenever it moves. Time in
    the file starts at the wall time of opening and runs on where the source's jumps back. A sweep is written once, when
    it is new; of the cloud at the start (and after a jump) all sweeps are. Use it from one thread.

    Args:
        path: file to write; replaced.

    Raises:
        UserError: the file cannot be written.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.frames = 0
        """Frames written so far."""
        self._channels: dict[str, int] = {}
        self._base = self._stamp = time.time_ns()
        self._last: Frame | None = None
        self._sources = 0  # so far
        self._pose: tuple[int, float, VehicleState] | None = None  # epoch, time [s] and state of the last pose
        self._torn = False
        self._cloud: NDArray[np.float32] | None = None
        try:
            self._file = self.path.open("wb")
            self._writer = Writer(self._file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
            self._writer.start(profile="ros2", library=f"aero-viz {importlib.metadata.version('aero-viz')}")
            self._flush()
        except OSError as error:
            raise UserError(f"Cannot write the flight log {path}: {error.strerror or error}.") from error

    def write(self, frame: Frame) -> None:
        """Append a frame; raises OSError when the disk does not take it, after which only `close` makes sense."""
        try:
            self._write(frame)
        except OSError:
            self._torn = True
            raise

    def write_pose(self, time: float, state: VehicleState) -> None:
        """Append where the drone is between two frames, `time` [s] being the source's, after that of the last frame."""
        if self._last is not None:
            self._write_pose(time, state, self._base + round(1e9 * time), epoch=self._last.epoch)

    def _write(self, frame: Frame) -> None:
        before = self._last
        stamp = self._next_stamp(frame)
        if before is None or before.source is not frame.source:
            self._attach_source(frame.source)
        if before is None or before.config is not frame.config:
            self._attach(f"config_{frame.config_version}.yaml", "application/yaml", format_config(frame.config))
        if before is None or before.epoch != frame.epoch or before.time != frame.time:
            self._write_pose(frame.time, frame.observation.actual_state, stamp, epoch=frame.epoch)
            self._write_sweeps(frame, stamp)
        if before is None or not np.array_equal(before.observation.goal.position, frame.observation.goal.position):
            self._add(encode_goal(frame, stamp), stamp)
        for message in encode_plan(frame, stamp):
            self._add(message, stamp)
        self._last = frame
        self.frames += 1
        if time.monotonic() - self._flushed > _FLUSH_PERIOD:
            self._flush()

    def _write_pose(self, at: float, state: VehicleState, stamp: int, *, epoch: int) -> None:
        """Write a pose once; body rates are the mean ones since the pose before, zero after a jump in time."""
        rates = np.zeros(3)
        if self._pose is not None and self._pose[0] == epoch:
            if self._pose[1] >= at:
                return
            rates = body_rates(self._pose[2], state, at - self._pose[1])
        self._pose = (epoch, at, state)
        for message in pose_messages(state, stamp, rates=rates):
            self._add(message, stamp)

    def close(self, *, dropped: int = 0) -> None:
        """Finish the file; `dropped` frames never reached it, which its metadata says. A torn file just ends."""
        try:
            if not self._torn:
                self._writer.add_metadata("flight_log", {"frames": str(self.frames), "dropped": str(dropped)})
                self._writer.finish()
        finally:
            self._file.close()

    def _next_stamp(self, frame: Frame) -> int:
        stamp = self._base + round(1e9 * frame.time)
        if self._last is not None and frame.epoch != self._last.epoch:
            self._base += self._stamp + 20_000_000 - stamp
            stamp = self._stamp + 20_000_000
            self._cloud = None
        self._stamp = stamp
        return stamp

    def _write_sweeps(self, frame: Frame, stamp: int) -> None:
        cloud = frame.observation.points
        if cloud is self._cloud:
            return
        added, whole = new_points(self._cloud, cloud)
        self._cloud = cloud
        parts = np.array_split(added, max(frame.observation.sweep_count, 1)) if whole else [added]
        for i, part in enumerate(parts):
            if len(part):
                self._add(encode_sweep(frame, part, stamp + i * _SWEEP_STEP), stamp + i * _SWEEP_STEP)

    def _add(self, message: Encoded, stamp: int) -> None:
        if message.topic not in self._channels:
            schema = self._writer.register_schema(message.kind, "ros2msg", DEFINITIONS[message.kind].encode())
            self._channels[message.topic] = self._writer.register_channel(message.topic, "cdr", schema)
        self._writer.add_message(self._channels[message.topic], stamp, message.data, stamp)

    def _attach_source(self, source: SourceInfo) -> None:
        suffix = f"_{self._sources}.json" if self._sources else ".json"
        self._sources += 1
        if source.world is not None:
            self._attach(f"world{suffix}", "application/json", json.dumps(source.world.to_dict(), allow_nan=False))
        settings = {"source": source.name, **source.settings}
        self._attach(f"flight{suffix}", "application/json", json.dumps(settings, allow_nan=False))

    def _attach(self, name: str, media_type: str, text: str) -> None:
        self._writer.add_attachment(self._stamp, self._stamp, name, media_type, text.encode())

    def _flush(self) -> None:
        self._writer.flush()
        self._file.flush()
        self._flushed = time.monotonic()


def new_points(before: NDArray[np.float32] | None, cloud: NDArray[np.float32]) -> tuple[NDArray[np.float32], bool]:
    """Return what an accumulated cloud holds beyond the one before it, and whether that is all of it.

    A cloud is made of sweeps, oldest first; from one to the next, sweeps leave at the front and join at the end.
    """
    if before is None or not len(before) or not len(cloud):
        return cloud, True
    for first in np.flatnonzero((before == cloud[0]).all(axis=1)):
        shared = len(before) - first
        if shared <= len(cloud) and np.array_equal(before[first:], cloud[:shared]):
            return cloud[shared:], False
    return cloud, True


@contextlib.contextmanager
def record(session: Session, path: str | Path) -> Iterator[FlightLog]:
    """Log every frame of a session from a thread of its own, while the context lasts.

    The engine never waits: frames that the disk cannot keep up with are dropped, counted in the file and announced. A
    disk that takes no more is announced, too, and ends the log, not the flight. At the end, a disk that is behind has
    ten seconds to catch up; frames that wait even then are dropped like the others.
    """
    log = FlightLog(path)
    sinks: list[Sink[Frame]] = []  # empty while the first frame may already be on its way
    failed = announced = False

    def write(frame: Frame) -> None:
        nonlocal failed, announced
        if failed:
            return
        try:
            log.write(frame)
        except OSError as error:
            failed = True
            session.notify(f"The flight log {path} ends here: {error.strerror or error}.", level="error")
        if sinks and sinks[0].dropped and not announced:
            announced = True
            session.notify(f"The flight log {path} cannot keep up: frames are left out.", level="error")

    sink = session.subscribe(write, every=True, name="flight-log")
    sinks.append(sink)
    try:
        yield log
    finally:
        session.unsubscribe(sink, timeout=_PATIENCE)
        sink.close(timeout=None)  # until the last write has ended, the file is that thread's
        if sink.dropped:
            text = f"The flight log {path} lacks {sink.dropped} frames: the disk was too slow for them."
            session.notify(text, level="error")
            _log.warning(text)  # the page may be closed by now
        with contextlib.suppress(OSError):
            log.close(dropped=sink.dropped)


@contextlib.contextmanager
def flight_recorder(path: str | Path) -> Iterator[FlightLog]:
    """Open a flight log for `aero_viz.flight.fly`, which writes every tick to it and drops none.

    Raises:
        UserError: the file cannot be written.
    """
    try:
        with contextlib.closing(FlightLog(path)) as log:
            yield log
    except OSError as error:
        raise UserError(f"Cannot write the flight log {path}: {error.strerror or error}.") from error
