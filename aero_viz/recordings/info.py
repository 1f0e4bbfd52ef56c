"""What is in a recording and what of it can be played."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from aero_viz.errors import UserError
from aero_viz.recordings.contents import Topic, read_contents
from aero_viz.recordings.recording import Recording, require_topics
from aero_viz.recordings.storage import open_storage, readable

__all__ = ["PointsPerSweep", "RecordingInfo", "inspect"]


@dataclass(frozen=True)
class PointsPerSweep:
    """Points of the playable sweeps as recorded, invalid ones included."""

    min: int
    median: int
    max: int


@dataclass(frozen=True)
class RecordingInfo:
    """A report on one recording."""

    path: str
    format: str
    duration_s: float
    """Time from the first to the last message of any topic [s]."""
    topics: tuple[Topic, ...]
    sweeps: int
    """How many sweeps can be played."""
    poses: int
    """How many poses place them."""
    points_topic: str | None
    pose_topic: str | None
    points_per_sweep: PointsPerSweep | None
    problems: tuple[str, ...]
    """What keeps sweeps from being played, and what the user should know, one sentence each."""

    def to_json(self) -> dict[str, Any]:
        """Return the report as plain values for `json.dumps`."""
        values = asdict(self)
        values["topics"] = [topic._asdict() for topic in self.topics]
        values["problems"] = list(self.problems)
        return values

    def format_table(self) -> str:
        """Return the report as text for people."""
        lines = [f"{self.path}: {self.format}, {self.duration_s:.1f} s"]
        width = max((len(topic.name) for topic in self.topics), default=0)
        kind = max((len(topic.type) for topic in self.topics), default=0)
        for topic in self.topics:
            use = {self.points_topic: "  <- sweeps", self.pose_topic: "  <- poses"}.get(topic.name, "")
            lines.append(f"  {topic.name:<{width}}  {topic.type:<{kind}}  {topic.count:>8}{use}")
        plural = "" if self.sweeps == 1 else "s"
        playable = f"{self.sweeps} sweep{plural} can be played, {self.poses} pose{'' if self.poses == 1 else 's'}"
        if self.points_per_sweep:
            p = self.points_per_sweep
            playable += f"; points per sweep: {p.min} min, {p.median} median, {p.max} max"
        return "\n".join([*lines, playable, *(f"note: {problem}" for problem in self.problems)])


def inspect(path: str | Path, *, points_topic: str | None = None, pose_topic: str | None = None) -> RecordingInfo:
    """Report what is in a recording; what keeps it from being played becomes one of the report's `problems`.

    Raises UserError when there is no recording at `path`, nothing in it can be read, or a topic that is named is not
    there or of the wrong type.
    """
    storage = open_storage(path)
    try:
        with readable(storage.path):
            contents = read_contents(storage)
            require_topics(contents, points_topic=points_topic, pose_topic=pose_topic)
            try:
                recording = Recording(storage, contents, points_topic, pose_topic)
            except UserError as error:
                topics = tuple(Topic(topic.name, topic.type, topic.count) for topic in contents.topics)
                problems = (*contents.problems, str(error))
                return RecordingInfo(str(storage.path), storage.format, contents.duration, topics, 0, 0, None, None,
                                     None, problems)  # fmt: skip
            counts = recording.sweep_counts
            return RecordingInfo(
                path=str(storage.path),
                format=storage.format,
                duration_s=contents.duration,
                topics=recording.topics,
                sweeps=len(counts),
                poses=0 if recording.poses is None else len(recording.poses.times),
                points_topic=recording.points_topic,
                pose_topic=recording.pose_topic,
                points_per_sweep=PointsPerSweep(int(counts.min()), int(np.median(counts)), int(counts.max())),
                problems=tuple(recording.problems),
            )
    finally:
        storage.close()
