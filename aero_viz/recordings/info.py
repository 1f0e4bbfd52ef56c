"""Report on the contents of a recording, and on the parts that can be played."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from aero_viz.errors import UserError
from aero_viz.recordings.choices import Choices, CloudFrame
from aero_viz.recordings.contents import Topic, read_contents
from aero_viz.recordings.findings import Finding, Measured, find_faults, measure
from aero_viz.recordings.folder_check import count_points
from aero_viz.recordings.opening import configure_recording, motion_in_map
from aero_viz.recordings.recording import Recording
from aero_viz.recordings.storage import Storage, open_storage, readable
from aero_viz.recordings.topics import require_topics
from aero_viz.text_table import format_table

if TYPE_CHECKING:
    from aero_viz.recordings.odometry import OdometryProgress
    from aero_viz.recordings.pose_check import PoseCheck


@dataclass(frozen=True)
class PointsPerSweep:
    """Number of points in a playable sweep, invalid ones included."""

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
    sweeps: int = 0
    """Number of sweeps that can be played."""
    poses: int = 0
    """Number of poses on the topic that is played."""
    points_topic: str | None = None
    pose_topic: str | None = None
    points_per_sweep: PointsPerSweep | None = None
    measured: Measured | None = None
    """Rates, range and field of view; None where nothing can be played."""
    pose_check: PoseCheck | None = None
    """Agreement of the poses with a registration of the sweeps, where it was asked for."""
    findings: tuple[Finding, ...] = ()
    """Faults of the recording, and properties to know of."""
    problems: tuple[str, ...] = ()
    """Reasons why sweeps cannot be played, and other notices for the user, one sentence each. If nothing can be played,
    the last one says why."""

    def to_dict(self) -> dict[str, Any]:
        """Return the report as plain values for JSON."""
        return asdict(self)

    def format_table(self) -> str:
        """Return the report as text for a terminal."""
        use = {self.points_topic: "<- sweeps", self.pose_topic: "<- poses"}
        rows = [["", topic.name, topic.type, str(topic.count), use.get(topic.name, "")] for topic in self.topics]
        playable = f"{_count(self.sweeps, 'sweep')} can be played, {_count(self.poses, 'pose')}"
        if self.points_per_sweep:
            points = self.points_per_sweep
            playable += (
                f"; points per sweep, invalid ones too: {points.min} min, {points.median} median, {points.max} max"
            )
        title = f"{self.path}: {self.format}, {self.duration_s:.1f} s"
        table = [format_table(rows, right=[3])] if rows else []
        measured = [self.measured.format_line()] if self.measured else []
        measured += [self.pose_check.format_line()] if self.pose_check else []
        notes = [f"note: {problem}" for problem in self.problems]
        if not self.sweeps and notes:
            notes[-1] = f"FAULT (unplayable): {self.problems[-1]}"
        findings = [
            f"{'FAULT' if finding.is_fault else 'hint'} ({finding.code}): {finding.evidence}. Next: {finding.advice}."
            for finding in self.findings
        ]
        return "\n".join([title, *table, playable, *measured, *notes, *findings])


def inspect(
    path: str | Path,
    *,
    points_topic: str | None = None,
    pose_topic: str | None = None,
    columns: str | None = None,
    sensor: str | None = None,
    cloud_frame: CloudFrame = "auto",
    check_poses: bool = False,
    **options: Any,
) -> RecordingInfo:
    """Return a report on a recording. What keeps it from being played becomes one of the report's `problems`.

    Args:
        path: file or folder.
        points_topic, pose_topic: topics to play from; None finds them by type.
        columns, sensor, cloud_frame: see `aero_viz.recordings.choices.Choices`.
        check_poses: registers all sweeps, with a `map` in that, to check the poses.
        options: other options of `open_recording`.

    Raises:
        UserError: there is no recording at `path`, nothing in it can be read, a named topic does not exist or is of
            the wrong type, or another option is wrong.
    """
    storage = open_storage(path, Choices(columns, sensor, cloud_frame))
    try:
        with readable(storage.path):
            contents = read_contents(storage)
            require_topics(contents, points_topic=points_topic, pose_topic=pose_topic)
            topics = tuple(Topic(topic.name, topic.type, topic.count) for topic in contents.topics)
            report = RecordingInfo(str(storage.path), storage.format, contents.duration, topics)
            try:
                recording = Recording(storage, contents, points_topic, pose_topic)
            except UserError as error:
                return replace(report, problems=(*contents.problems, str(error)))
            map_options = {name: options.pop(name, None) for name in ("map", "map_start")} if check_poses else {}
            configure_recording(recording, storage, contents, **options)
            check = _check_poses(recording, storage, options.get("progress"), **map_options) if check_poses else None
            fault = None if check is None else check.finding()
            counts, notices = count_points(recording, storage)
            return replace(
                report,
                sweeps=len(recording.sweep_times),
                poses=0 if recording.poses is None else len(recording.poses.times),
                points_topic=recording.points_topic,
                pose_topic=recording.pose_topic,
                measured=measure(recording),
                pose_check=check,
                findings=(*([fault] if fault else []), *find_faults(recording)),
                points_per_sweep=PointsPerSweep(int(counts.min()), int(np.median(counts)), int(counts.max())),
                problems=(*recording.problems, *notices),
            )
    finally:
        storage.close()


def _check_poses(
    recording: Recording, storage: Storage, progress: OdometryProgress | None, map: Path | None, map_start: Any
) -> PoseCheck:
    from aero_viz.recordings.pose_check import check_by_map, check_by_sweeps

    if recording.poses is None:
        raise UserError(f"{storage.path} has no poses to check: give them with --poses, or locate it in a --map.")
    show = progress or (lambda done, total: None)
    if map is None:
        return check_by_sweeps(recording, recording.poses, show)
    motion = motion_in_map(recording, storage, Path(map), map_start, show)
    return check_by_map(recording.poses, motion, len(recording.sweep_times))


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
