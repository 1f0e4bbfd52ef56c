"""The flight log: an MCAP file, written in chunks while flying, so that a crash costs the last second at most."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import json
import statistics
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from aero_planner import PlannerConfig
from aero_planner.config_file import format_config
from aero_viz.errors import UserError
from aero_viz.flight import FlightResult, FlightSource
from aero_viz.frame import Frame
from aero_viz.logs.messages import Encoded, definition, encode_plan, encode_pose, encode_sweep
from aero_viz.scenes import World
from aero_viz.sensors import LidarModel
from aero_viz.session import Session
from aero_viz.sinks import Sink

__all__ = ["FlightLog", "fly_and_log", "new_points", "record"]

_CHUNK_BYTES = 1 << 20
_FLUSH_PERIOD = 1.0  # of wall time [s]: a killed process loses no more than this
_SWEEP_STEP = 1000  # between the sweeps of a cloud that is logged whole [ns]


class FlightLog:
    """Writes frames to an MCAP file with the messages of `messages`, and each configuration as an attachment.

    Time in the file starts at the wall time of opening and runs on where the source's jumps back. A sweep is written
    once, when it is new; of the cloud at the start (and after a jump) all sweeps are. Use it from one thread.

    Args:
        path: file to write; replaced.
        world: kept in the file as the attachment world.json.

    Raises:
        UserError: the file cannot be written.
    """

    def __init__(self, path: str | Path, *, world: World | None = None) -> None:
        self.path = Path(path)
        self.frames = 0
        """Frames written so far."""
        self._channels: dict[str, int] = {}
        self._base = self._stamp = time.time_ns()
        self._last: Frame | None = None
        self._torn = False
        self._cloud: NDArray[np.float32] | None = None
        try:
            self._file = self.path.open("wb")
            self._writer = Writer(self._file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
            self._writer.start(profile="ros2", library="aero-viz")
            if world is not None:
                self._attach("world.json", "application/json", json.dumps(world.to_dict()))
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

    def _write(self, frame: Frame) -> None:
        before = self._last
        stamp = self._next_stamp(frame)
        if before is None or before.config is not frame.config:
            self._attach(f"config_{frame.config_version}.yaml", "application/yaml", format_config(frame.config))
        if before is None or before.epoch != frame.epoch or before.time != frame.time:
            for message in encode_pose(frame, stamp):
                self._add(message, stamp)
            self._write_sweeps(frame, stamp)
        for message in encode_plan(frame, stamp):
            self._add(message, stamp)
        self._last = frame
        self.frames += 1
        if time.monotonic() - self._flushed > _FLUSH_PERIOD:
            self._flush()

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
            schema = self._writer.register_schema(message.kind, "ros2msg", definition(message.kind).encode())
            self._channels[message.topic] = self._writer.register_channel(message.topic, "cdr", schema)
        self._writer.add_message(self._channels[message.topic], stamp, message.data, stamp)

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
    disk that takes no more is announced, too, and ends the log, not the flight.
    """
    log = FlightLog(path, world=session.source.scenery.world)
    sinks: list[Sink] = []  # empty while the first frame may already be on its way
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
        sink.drain()
        session.unsubscribe(sink)
        with contextlib.suppress(OSError):
            log.close(dropped=sink.dropped)


def fly_and_log(
    world: World,
    log: str | Path,
    *,
    config: PlannerConfig | None = None,
    seed: int = 0,
    device: str = "cpu",
    lidar: LidarModel | None = None,
    speed: float | None = None,
    trajectory: str | Path | None = None,
    config_name: str = "custom",
) -> FlightResult:
    """Fly once, headless, and log every tick, none dropped; otherwise as `aero_viz.flight.fly`.

    Raises:
        UserError: an option is out of range, or a file cannot be written.
    """
    config = config or PlannerConfig()
    try:
        config = config if speed is None else config.replace({"vehicle.speed_limit": speed})
    except ValueError as error:
        raise UserError(f"Cannot fly {world.name!r}: {error}") from error
    source = FlightSource(world, lidar=lidar, seed=seed, device=device)
    plan_ms: list[float] = []
    flight_log = FlightLog(log, world=world)
    session = Session(source, config=config, device=device, seed=seed)
    try:
        with contextlib.ExitStack() as stack:
            stack.callback(session.close)
            stack.callback(flight_log.close)
            rows = None
            if trajectory is not None:
                file = stack.enter_context(open(trajectory, "w", newline="", encoding="utf-8"))
                rows = csv.writer(file)
                rows.writerow(["t", "x", "y", "z", "vx", "vy", "vz"])
            while source.outcome is None:
                frame = session.tick()
                flight_log.write(frame)
                plan_ms.append(frame.timings_ms["plan"])
                if rows is not None:
                    state = frame.observation.state
                    values = [frame.time, *np.asarray(state.position), *np.asarray(state.velocity)]
                    rows.writerow([f"{value:.6f}" for value in values])
    except OSError as error:
        raise UserError(f"Cannot write {error.filename or log}: {error.strerror or error}.") from error
    median = statistics.median(plan_ms) if plan_ms else None
    return dataclasses.replace(source.result(), config=config_name, plan_ms_median=median)
