"""A flight log as a source: the recorded motion, goal, plans and outcome, as they were."""

from __future__ import annotations

import bisect
import dataclasses
import json
import struct
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from aero_planner import PlanStatus
from aero_planner.onboard.ros_messages import PLAN, PLAN_DEFINITION
from aero_viz.recordings.recording import Recording
from aero_viz.recordings.source import RecordingSource
from aero_viz.scenes import World
from aero_viz.session.source import Observation, RecordedPlan

__all__ = ["FlightReplay", "is_flight_log", "log_typestore"]

_TOPICS = ("/goal", "/plan", "/plan/best", "/odometry")


def is_flight_log(path: str | Path) -> bool:
    """Return True if `path` is an MCAP file with the plans of this planner."""
    if Path(path).suffix.lower() != ".mcap" or not Path(path).is_file():
        return False
    try:
        with Path(path).open("rb") as file:
            summary = make_reader(file).get_summary()
    except (McapError, OSError, ValueError, struct.error):
        return False
    return summary is not None and {"/plan", "/plan/best"} <= {channel.topic for channel in summary.channels.values()}


class FlightReplay(RecordingSource):
    """Replays a flight log. The planner runs on it as on any recording, beside the recorded plans.

    Args:
        recording: the log; `close` closes it.
        path: file of the log.
        goal_ahead: distance of the goal along the recorded path [m], where no goal is recorded.
    """

    def __init__(self, recording: Recording, path: str | Path, *, goal_ahead: float = 15.0) -> None:
        if recording.poses is not None:
            recording.poses = recording.poses.without_offset()  # the goals, plans and world are in the recorded frame
        super().__init__(recording, goal_ahead=goal_ahead)
        poses = recording.poses
        self.start = 0.0 if poses is None else float(poses.times[0])
        """Source time of the first pose [s]."""
        self._goals: list[tuple[float, NDArray[np.float64]]] = []
        self._plans: list[RecordedPlan] = []
        self._world: World | None = None
        self._ending = ""
        self._settings: dict[str, Any] = {}
        with Path(path).open("rb") as file:
            self._read(make_reader(file))
        self._plan_times = [plan.time for plan in self._plans]
        ending = f" {self._ending}" if self._ending else ""
        self.info = dataclasses.replace(
            self.info,
            world=self._world,
            settings=self._settings,
            recorded_plan=self._plan_at if self._plans else None,
            notices=(f"Recorded flight: goal and plans are those of the log.{ending}", *recording.problems),
        )

    def observe(self) -> Observation:
        """Return the planner's input at this tick."""
        observation = super().observe()
        if self._world is None:
            return observation
        return dataclasses.replace(observation, ground_height=self._world.ground_height)

    @property
    def explanation(self) -> str | None:
        """How the recorded flight ended, once its end is reached, and the sweeps found to be unreadable so far."""
        sentences = [self._ending if self.outcome is not None else "", super().explanation or ""]
        return " ".join(sentence for sentence in sentences if sentence) or None

    def _recorded_goal(self, time: float) -> NDArray[np.float64] | None:
        row = bisect.bisect_right(self._goals, time + 1e-6, key=lambda entry: entry[0]) - 1
        return self._goals[max(row, 0)][1] if self._goals else None

    def _plan_at(self, time: float) -> RecordedPlan | None:
        row = bisect.bisect_right(self._plan_times, time + 1e-6) - 1
        return self._plans[row] if row >= 0 else None

    def _read(self, reader: Any) -> None:
        for attachment in reader.iter_attachments():
            if attachment.name == "world.json":
                self._world = World.from_dict(json.loads(attachment.data))
            elif attachment.name == "flight.json":
                self._settings = json.loads(attachment.data)
        for entry in reader.iter_metadata():
            if entry.name == "flight_log" and (outcome := entry.metadata.get("outcome")):
                explanation = entry.metadata.get("explanation", "")
                self._ending = f"It ended with: {outcome.replace('_', ' ')}. {explanation}".strip()
        first: int | None = None
        summary: Any = None
        for schema, channel, message in reader.iter_messages(topics=_TOPICS):
            if channel.topic == "/odometry":
                first = message.log_time if first is None else first
                continue
            decoded: Any = log_typestore().deserialize_cdr(message.data, schema.name)
            time = (message.log_time - (message.log_time if first is None else first)) * 1e-9 + self.start
            if channel.topic == "/goal":
                place = decoded.pose.position
                self._goals.append((time, np.array((place.x, place.y, place.z))))
            elif channel.topic == "/plan":
                summary = decoded
            elif summary is not None:
                self._plans.append(_plan(time, summary, decoded))


def _plan(time: float, summary: Any, path: Any) -> RecordedPlan:
    places = [pose.pose.position for pose in path.poses]
    return RecordedPlan(
        time=time,
        path=np.array([(place.x, place.y, place.z) for place in places], dtype=np.float32),
        best=int(summary.best),
        kinds=tuple(summary.kinds),
        status=PlanStatus(int(summary.status)),
        stage2_cost=np.asarray(summary.stage2_cost, dtype=np.float32),
        clearance=np.asarray(summary.clearance, dtype=np.float32),
    )


@cache
def log_typestore() -> Typestore:
    """Return the types of the messages in a flight log."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(PLAN_DEFINITION, PLAN))
    return store
