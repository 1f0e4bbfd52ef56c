"""The contents of a flight log besides its clouds: plans, goals, poses, world, configurations and the outcome.

A separate process reads them, with limits on its memory and time, because the reader of the mcap package expands
whatever a file contains. The process imports this module for every log, so modules that only the parent needs are
imported on use: the planner takes a second.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from aero_planner.mission_progress import MissionProgress
from aero_planner.missions import Mission
from aero_planner.onboard.ros_definitions import COSTS, COSTS_DEFINITION, PLAN, PLAN_DEFINITION
from aero_planner.plan import PlanStatus
from aero_planner.user_file import open_user_file, parse_json
from aero_viz.errors import UserError
from aero_viz.reader_process import Limits, ReadCancelled, Reader, ReaderProcess
from aero_viz.recordings.mcap_file import MCAP_MAGIC, McapFile

if TYPE_CHECKING:
    from aero_planner.config import DroneConfig
    from aero_viz.scenes import World

_TOPICS = ("/goal", "/plan", "/plan/best", "/plan/costs", "/odometry")
_PLAN_TOPICS = {"/plan", "/plan/best"}
_TEXT_MAX = 1000
_COSTS = ("stage2_cost", "goal_cost", "collision_cost", "clearance")


@dataclass(frozen=True, eq=False)
class LoggedPlan:
    """A plan in a log. M instances with N time steps; the arrays have the shape [M]."""

    stamp: int
    """Time of the log [ns]."""
    best: int
    status: int
    kinds: tuple[str, ...]
    stage2_cost: NDArray[np.float32]
    goal_cost: NDArray[np.float32]
    collision_cost: NDArray[np.float32]
    clearance: NDArray[np.float32]
    plan_ms: float
    config_version: int
    path: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    """Positions of the chosen rollout [m], shape [N+1, 3], world frame; empty if they were not logged."""
    costs: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    """Terms of the cost by name; empty for the goal and the collision cost of AERO-MPPI."""


@dataclass(eq=False)
class LogContents:
    """Contents of a log, in the order of time."""

    path: str
    attachments: dict[str, bytes] = field(default_factory=dict)
    stamps: dict[str, int] = field(default_factory=dict)
    """Time of each attachment [ns]."""
    outcome: str = ""
    explanation: str = ""
    """Outcome of the flight, empty if the log does not say."""
    pose_stamps: list[int] = field(default_factory=list)
    """[ns]."""
    poses: list[tuple[float, float, float, float]] = field(default_factory=list)
    """x, y, z [m] and speed [m/s] of each pose."""
    goals: list[tuple[int, NDArray[np.float64]]] = field(default_factory=list)
    """Time of the log [ns] and place [m] of each goal."""
    plans: list[LoggedPlan] = field(default_factory=list)
    damaged: int = 0
    """Number of goals, plans and poses that were left out because their numbers are impossible."""

    @property
    def damage(self) -> str:
        """Sentence on what was left out, empty if nothing was."""
        found = f"{self.damaged} goals, plans and poses of the log have impossible numbers: left out."
        return found if self.damaged else ""

    def world(self, name: str = "world.json") -> World | None:
        """Return the world of the flight, or another one that is attached by name; None if it is not in the log.

        Raises:
            UserError: it is damaged.
        """
        from aero_viz.scenes import World

        content = self._json(name)
        try:
            return None if content is None else World.from_dict(content)
        except ValueError as error:
            raise UserError(f"The world in {self.path} is damaged: {error}") from error

    def legs(self) -> list[tuple[int, MissionProgress]]:
        """Return time [ns] and progress at the beginning of each leg of the missions; empty if there were none.

        Raises:
            UserError: one is damaged.
        """
        names = [name for name in self.attachments if name.startswith("leg_change")]
        legs: list[tuple[int, MissionProgress]] = []
        mission: Mission | None = None
        for name in sorted(names, key=lambda name: (self.stamps[name], len(name), name)):
            content = self._json(name)
            try:
                mission = Mission.from_dict(content["mission"]) if "mission" in content else mission
                if mission is None:
                    raise ValueError("its mission is missing.")
                legs.append((self.stamps[name], MissionProgress.from_dict(mission, content["progress"])))
            except (KeyError, TypeError, ValueError) as error:
                raise UserError(f"The leg {name} in {self.path} is damaged: {error}") from error
        return legs

    def settings(self) -> dict[str, Any]:
        """Return the settings of the flight by name, empty if they are not in the log.

        Raises:
            UserError: they are damaged.
        """
        from aero_viz.flight.flight_settings import FlightSettings

        content = self._json("flight.json")
        if content is None:
            return {}
        try:
            FlightSettings.from_dict(content)
        except (AttributeError, TypeError, ValueError) as error:
            raise UserError(f"The settings of the flight in {self.path} are damaged: {error}.") from error
        return content

    def config(self, version: int | None = None) -> DroneConfig | None:
        """Return the configuration of this version or, if there is none, the last one; None if the log has none.

        Raises:
            UserError: it is damaged.
        """
        from aero_planner.config.file import ConfigFile
        from aero_planner.config.yaml_entries import parse_entries
        from aero_viz.planners.registry import config_type

        names = sorted((n for n in self.attachments if n.startswith("config") and n.endswith(".yaml")), key=len)
        if not names:
            return None
        name = f"config_{version}.yaml" if f"config_{version}.yaml" in self.attachments else names[-1]
        place = f"{self.path}: {name}"
        try:
            file = ConfigFile(place, parse_entries(self.attachments[name].decode(), place))
            return file.planner_config(config_type(file.planner, of_file=True))
        except ValueError as error:
            raise UserError(str(error)) from error

    def _json(self, name: str) -> Any:
        try:
            return parse_json(self.attachments.get(name, b"null"))
        except ValueError as error:
            raise UserError(f"{name} in {self.path} is damaged: {error}.") from error


def is_flight_log(path: str | Path) -> bool:
    """Return True if `path` is an MCAP file with the plans of this planner. It may be cut off."""
    if not Path(path).is_file():
        return False
    try:
        with open_user_file(path) as file:
            if file.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
                return False
            if _is_cut_off(file):
                return _has_plans(Path(path))
            summary = make_reader(file).get_summary()
    except Exception:  # a damaged summary can fail anywhere in the decoders
        return False
    return summary is not None and {channel.topic for channel in summary.channels.values()} >= _PLAN_TOPICS


def _is_cut_off(file: IO[bytes]) -> bool:
    """Return True if an MCAP file has no end, where its summary is; the file is at its beginning afterwards."""
    file.seek(-len(MCAP_MAGIC), os.SEEK_END)
    end = file.read()
    file.seek(0)
    return end != MCAP_MAGIC


def _has_plans(path: Path) -> bool:
    """Return True if the whole chunks of an MCAP file hold the plans of this planner."""
    missing = set(_PLAN_TOPICS)
    with contextlib.closing(McapFile(path)) as recording:
        for message in recording.scan(()):
            missing.discard(message.channel.topic)
            if not missing:
                return True
    return False


def read_log(path: str | Path, read: Reader | None = None) -> LogContents:
    """Return the contents of a flight log.

    Args:
        path: the file.
        read: reads it; None starts a process for it.

    Raises:
        UserError: it is damaged, or reading it takes more memory or time than its size allows.
    """
    path = Path(path)
    try:
        return (read or ReaderProcess(Limits.for_file(path.stat().st_size)))(_read, str(path))
    except ReadCancelled:
        raise
    except (UserError, OSError) as error:
        raise UserError(f"{path} cannot be read as a flight log: {str(error).rstrip('.')}.") from error


def _read(path: str) -> LogContents:
    try:
        return _read_records(path)
    except McapError as error:
        raise UserError(f"{type(error).__name__}: {error}") from error


def _read_records(path: str) -> LogContents:
    contents = LogContents(path)
    with open_user_file(path) as file:
        if _is_cut_off(file):
            messages = _read_whole_records(file, contents)
        else:
            reader = make_reader(file, validate_crcs=True)
            for entry in (*reader.iter_attachments(), *reader.iter_metadata()):
                _add_entry(contents, entry)
            messages = reader.iter_messages(topics=_TOPICS)
        for schema, channel, message in messages:
            content = _typestore().deserialize_cdr(message.data, "" if schema is None else schema.name)
            contents.damaged += not _add(contents, channel.topic, message.log_time, content)
    return contents


def _read_whole_records(file: IO[bytes], contents: LogContents) -> list[tuple[Schema | None, Channel, Message]]:
    """Add the attachments and metadata of a file without its end; return the messages in its whole chunks by time."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    messages: list[tuple[Schema | None, Channel, Message]] = []
    for record in _records_before_cut(file):
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, Message):
            channel = channels.get(record.channel_id)
            if channel is not None and channel.topic in _TOPICS:
                messages.append((schemas.get(channel.schema_id), channel, record))
        elif isinstance(record, Attachment | Metadata):
            _add_entry(contents, record)
    return sorted(messages, key=lambda entry: entry[2].log_time)


def _records_before_cut(file: IO[bytes]) -> Iterator[Any]:
    """Yield the records of a file up to the first one that is incomplete."""
    records = StreamReader(file, validate_crcs=True, record_size_limit=os.fstat(file.fileno()).st_size).records
    with contextlib.suppress(Exception):  # the decoders fail in many ways where the file is cut
        yield from records


def _add_entry(contents: LogContents, entry: Attachment | Metadata) -> None:
    """Add an attachment or the metadata of the log to the contents."""
    if isinstance(entry, Attachment):
        contents.attachments[entry.name], contents.stamps[entry.name] = entry.data, entry.log_time
    elif entry.name == "flight_log":
        contents.outcome = _printable(entry.metadata.get("outcome", ""))
        contents.explanation = _printable(entry.metadata.get("explanation", ""))


def _add(contents: LogContents, topic: str, stamp: int, message: Any) -> bool:
    """Add a message to the contents; return False if its numbers are impossible."""
    if topic == "/plan":
        plan = _plan(stamp, message)
        contents.plans += [] if plan is None else [plan]
        return plan is not None
    if topic == "/plan/best":
        path, last = _path(message), contents.plans[-1] if contents.plans else None
        if path is not None and last is not None and last.stamp == stamp:
            contents.plans[-1] = replace(last, path=path)
        return path is not None
    if topic == "/plan/costs":
        last = contents.plans[-1] if contents.plans else None
        shape = len(message.terms), 0 if last is None else len(last.kinds)
        if last is None or last.stamp != stamp or len(message.values) != shape[0] * shape[1]:
            return False
        table = np.asarray(message.values, np.float32).reshape(shape)
        contents.plans[-1] = replace(last, costs=dict(zip(map(_printable, message.terms), table, strict=True)))
        return True
    if topic == "/goal":
        place = np.array([getattr(message.pose.position, axis) for axis in "xyz"])
        contents.goals += [(stamp, place)] if np.isfinite(place).all() else []
        return bool(np.isfinite(place).all())
    place, speed = message.pose.pose.position, message.twist.twist.linear
    pose = place.x, place.y, place.z, math.hypot(speed.x, speed.y, speed.z)
    if not all(map(math.isfinite, pose)):
        return False
    contents.pose_stamps.append(stamp)
    contents.poses.append(pose)
    return True


def _plan(stamp: int, message: Any) -> LoggedPlan | None:
    """Return the plan in a message, None if its numbers do not fit together."""
    costs: dict[str, Any] = {name: np.asarray(getattr(message, name), np.float32) for name in _COSTS}
    count = len(message.kinds)
    if any(len(values) != count for values in costs.values()) or not (
        0 <= message.best < count or message.best == count == 0
    ):
        return None
    if message.status not in list(PlanStatus) or not np.isfinite(message.plan_ms):
        return None
    return LoggedPlan(
        stamp,
        int(message.best),
        int(message.status),
        tuple(map(_printable, message.kinds)),
        **costs,
        plan_ms=float(message.plan_ms),
        config_version=int(message.config_version),
    )


def _path(message: Any) -> NDArray[np.float32] | None:
    """Return the positions in a message [m], [n, 3]; None if they are not finite."""
    places = [pose.pose.position for pose in message.poses]
    path = np.array([(place.x, place.y, place.z) for place in places], np.float32).reshape(-1, 3)
    return path if np.isfinite(path).all() else None


def _printable(text: str) -> str:
    return "".join(letter if letter.isprintable() else "?" for letter in text[:_TEXT_MAX])


@cache
def _typestore() -> Typestore:
    """Return the types of the messages in a flight log."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(PLAN_DEFINITION, PLAN))
    store.register(get_types_from_msg(COSTS_DEFINITION, COSTS))
    return store
