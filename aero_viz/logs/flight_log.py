"""The flight log: an MCAP file that is flushed every second, so that a crash loses no more than that."""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import logging
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer

from aero_planner import VehicleState
from aero_planner.config.file import format_config
from aero_planner.mailbox import Mailbox
from aero_planner.mission_progress import MissionProgress
from aero_planner.onboard.ros_definitions import DEFINITIONS
from aero_planner.onboard.ros_messages import Encoded
from aero_planner.output_files import open_alone
from aero_viz.errors import UserError
from aero_viz.logs.flight_messages import FlightMessages
from aero_viz.session import Session
from aero_viz.session.frame import Frame
from aero_viz.session.source import SourceInfo

_log = logging.getLogger(__name__)

_CHUNK_BYTES = 1 << 20
_FLUSH_PERIOD = 1.0  # wall time [s]; a killed process loses no more than this
_CLOSE_TIMEOUT = 10.0  # [s] for a slow disk to catch up at the end


class FlightLog:
    """Writes frames to an MCAP file, with the messages of the drone's own log; see `FlightMessages`.

    Attachments hold every configuration, and the world and settings of every source: world.json and flight.json for the
    first, world_1.json and flight_1.json for the next. Changes during a flight have the stamp of their frame: the whole
    world is world_change_1.json, wind and faults are conditions_change_2.json, and the next leg of a mission, with how
    the one before it has ended, is leg_change_3.json. A log must be used from one thread.

    Args:
        path: file to write; an existing file is replaced.

    Raises:
        UserError: the file cannot be written.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.frames = 0
        """Number of frames written so far."""
        self._channels: dict[str, int] = {}
        self._messages = FlightMessages()
        self._sources = self._changes = 0
        self._failed = False
        try:
            self._file = open_alone(self.path)
            self._writer = Writer(self._file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
            self._writer.start(profile="ros2", library=f"aero-viz {importlib.metadata.version('aero-viz')}")
            self._flush()
        except OSError as error:
            raise UserError(f"Cannot write the flight log {path}: {error.strerror or error}.") from error

    def write(self, frame: Frame) -> None:
        """Append a frame.

        Raises:
            OSError: the file cannot be written; only `close` may be called then.
        """
        try:
            self._write(frame)
        except OSError:
            self._failed = True
            raise

    def write_pose(self, time: float, state: VehicleState) -> None:
        """Append the pose of the drone between two frames.

        Args:
            time: source time, later than that of the last frame [s].
            state: true state.
        """
        for message, stamp in self._messages.encode_pose(time, state):
            self._add(message, stamp)

    def _write(self, frame: Frame) -> None:
        last = self._messages.last
        messages = self._messages.encode(frame)
        if last is None or last.source is not frame.source:
            self._attach_source(frame.source)
            last_world, conditions, mission = frame.source.world, frame.observation.conditions, None
        else:
            last_world, conditions = last.moving_world, last.observation.conditions
            mission = last.observation.mission
        if frame.moving_world is not last_world and frame.moving_world is not None:
            self._attach_change("world", frame.moving_world.to_dict())
        if frame.observation.conditions != conditions:
            self._attach_change("conditions", frame.observation.conditions)
        if frame.observation.mission is not None:
            self._attach_leg(mission, frame.observation.mission)
        config = frame.base_config or frame.config
        if last is None or (last.base_config or last.config) is not config:
            self._attach(f"config_{frame.config_version}.yaml", "application/yaml", format_config(config))
        for message, stamp in messages:
            self._add(message, stamp)
        self.frames += 1
        if time.monotonic() - self._flushed > _FLUSH_PERIOD:
            self._flush()

    def close(self, *, dropped: int = 0) -> None:
        """Finish the file, unless writing it has failed.

        Args:
            dropped: number of frames that were not written, for the metadata.
        """
        try:
            if not self._failed:
                last = self._messages.last
                facts = {"frames": str(self.frames), "dropped": str(dropped)}
                if last is not None and last.outcome is not None:
                    facts |= {"outcome": last.outcome, "explanation": last.explanation or ""}
                self._writer.add_metadata("flight_log", facts)
                self._writer.finish()
        finally:
            self._file.close()

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

    def _attach_leg(self, last: MissionProgress | None, now: MissionProgress) -> None:
        """Attach the progress at the beginning of a leg, and the mission if it is another one.

        A mission to a single goal is told by the topic of the goal.
        """
        is_new = last is None or last.mission is not now.mission
        is_told = now.mission.is_single and (last is None or last.mission.is_single)
        if not is_told and (is_new or last is None or last.index != now.index):
            mission = {"mission": now.mission.to_dict()} if is_new else {}
            self._attach_change("leg", {**mission, "progress": now.to_dict()})

    def _attach_change(self, name: str, content: Any) -> None:
        self._changes += 1
        self._attach(f"{name}_change_{self._changes}.json", "application/json", json.dumps(content, allow_nan=False))

    def _attach(self, name: str, media_type: str, text: str) -> None:
        stamp = self._messages.stamp
        self._writer.add_attachment(stamp, stamp, name, media_type, text.encode())

    def _flush(self) -> None:
        self._writer.flush()
        self._file.flush()
        self._flushed = time.monotonic()


@contextlib.contextmanager
def record(session: Session, path: str | Path) -> Iterator[FlightLog]:
    """Log every frame of a session on a separate thread while the context is open.

    The engine never waits for the disk. If the disk is too slow, frames are dropped, counted in the file and reported
    by a notice. If writing fails, a notice reports it, and the log ends, but not the flight. At the end, a slow disk
    has ten seconds to catch up; frames that still wait then are dropped.
    """
    log = FlightLog(path)
    sinks: list[Mailbox[Frame]] = []  # empty if the first frame arrives before `subscribe` returns
    has_failed = has_announced = False

    def write(frame: Frame) -> None:
        nonlocal has_failed, has_announced
        if has_failed:
            return
        try:
            log.write(frame)
        except OSError as error:
            has_failed = True
            session.notify(f"The flight log {path} ends here: {error.strerror or error}.", level="error")
        if sinks and sinks[0].dropped and not has_announced:
            has_announced = True
            session.notify(f"The flight log {path} cannot keep up: frames are dropped.", level="error")

    sink = session.subscribe(write, every=True, name="flight-log")
    sinks.append(sink)
    try:
        yield log
    finally:
        session.unsubscribe(sink, timeout=_CLOSE_TIMEOUT)
        sink.close(timeout=None)  # the file belongs to the sink's thread until its last write ends
        if sink.dropped:
            text = f"The flight log {path} lacks {sink.dropped} frames: the disk was too slow for them."
            session.notify(text, level="error")
            _log.warning(text)  # the page may be closed already
        with contextlib.suppress(OSError):
            log.close(dropped=sink.dropped)


@contextlib.contextmanager
def flight_recorder(path: str | Path) -> Iterator[FlightLog]:
    """Open a flight log as a recorder of `aero_viz.flight.fly`, which writes every tick and drops none.

    Raises:
        UserError: the file cannot be written.
    """
    try:
        with contextlib.closing(FlightLog(path)) as log:
            yield log
    except OSError as error:
        raise UserError(f"Cannot write the flight log {path}: {error.strerror or error}.") from error
