"""A recording: sweeps read on demand and the poses they were taken from."""

from __future__ import annotations

import difflib
from collections import OrderedDict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_planner.quaternions import rotation_matrix
from aero_viz.errors import UserError
from aero_viz.recordings.clouds import CLOUD_TYPES, cloud_layout, decode_cloud
from aero_viz.recordings.contents import CloudEntry, Contents, Topic, TopicContents, read_contents
from aero_viz.recordings.messages import POSE_TYPES, TF_TYPES
from aero_viz.recordings.poses import PoseTrack
from aero_viz.recordings.storage import Storage, open_storage, readable
from aero_viz.recordings.transforms import IDENTITY, Transform

__all__ = ["PointSweep", "Recording", "open_recording", "require_topics"]

_CACHED_SWEEPS = 4
_ROLES = {"points": (CLOUD_TYPES, "not a point cloud"), "pose": ((*POSE_TYPES, *TF_TYPES), "which gives no poses")}
"""Types of message that topics of each role have, and what to say of another."""


class PointSweep(NamedTuple):
    """One sweep of the LiDAR."""

    time: float
    """Its stamp [s] from the recording's first playable sweep."""
    points: NDArray[np.float32]
    """Valid points [m], shape [P, 3], in the body frame: the sensor's frame unless the recording gives an extrinsic."""
    point_times: NDArray[np.float32] | None
    """Time of each point after `time` [s], shape [P]; None where it was not recorded."""
    dropped: int
    """Rows left out: not finite, out of any range, or all zero ("no return")."""


class _Poses(NamedTuple):
    topic: TopicContents
    track: PoseTrack
    extrinsic: Transform
    notice: str


class Recording:
    """A recording of LiDAR sweeps and poses; open it with `open_recording`. Use it from one thread at a time.

    Time runs in seconds from the first playable sweep: the first one that has points and a pose. Where the recording
    says how the sensor sits on the body (static transforms from the poses' child frame to the clouds' frame), points
    are moved into the body's frame; otherwise the sensor is the body.
    """

    def __init__(self, storage: Storage, contents: Contents, points_topic: str | None, pose_topic: str | None):
        self._storage = storage
        self.path = storage.path
        self.format = storage.format
        """"mcap", "rosbag1", "rosbag2-mcap" or "rosbag2-sqlite3"."""
        self.topics = tuple(Topic(topic.name, topic.type, topic.count) for topic in contents.topics)
        self.duration = contents.duration
        """Time from the first to the last message of any topic [s]."""
        self.problems: list[str] = list(contents.problems)
        """What the user should know, one sentence each."""
        cloud = _cloud_topic(contents, points_topic)
        self.points_topic = cloud.name
        self._kind, self._encoding = cloud.type, cloud.encoding
        entries = sorted((entry for entry in cloud.clouds if entry.count), key=lambda entry: entry.time)
        if not entries:
            raise UserError(f"no sweep on {cloud.name} of {self.path} has a point{_others(contents, cloud)}")
        if len(entries) < len(cloud.clouds):
            empty = len(cloud.clouds) - len(entries)
            self.problems.append(f"{empty} of {len(cloud.clouds)} sweeps on {cloud.name} have no points: left out")
        self._set_timeline(contents, entries, pose_topic)
        self.sweep_counts = np.array([entry.count for entry in self._entries], np.int64)
        """Points of each playable sweep as recorded, invalid ones included, shape [n]."""
        self.damaged_sweeps: set[int] = set()
        """Playable sweeps that turned out to be unreadable; they play as sweeps without points."""
        self._cache: OrderedDict[int, PointSweep] = OrderedDict()
        if not any(len(self.sweep(i).points) for i in range(len(self._entries))):
            said = f"no sweep on {cloud.name} of {self.path} has a valid point"
            raise UserError(f"{said}, all are zero, not finite or out of any range{_others(contents, cloud)}")

    def _set_timeline(self, contents: Contents, entries: list[CloudEntry], pose_topic: str | None) -> None:
        """Choose the poses and the clock, and keep the sweeps that have a pose."""
        start = entries[0].time
        poses, stamped, covered = _choose_poses(contents, entries, pose_topic)
        if poses is None:
            self.problems.append("no poses are recorded: the sensor is taken to stand still")
        elif not covered.all():
            self.problems.append(f"no pose covers sweeps {_ranges(np.flatnonzero(~covered))} of {len(entries)}")
        if not stamped:
            self.problems.append("the stamps of sweeps and poses are on different clocks: times of arrival are used")
        if poses is not None and poses.notice:
            self.problems.append(poses.notice)
        times = _times(entries, stamped=stamped)[covered]
        kept = [entry for entry, keep in zip(entries, covered, strict=True) if keep]
        order = np.argsort(times, kind="stable")
        self._entries: list[CloudEntry] = [kept[i] for i in order]
        times = times[order]
        self.sweep_times: NDArray[np.float64] = (times - times[0]) * 1e-9
        """Stamps of the playable sweeps [s] from the first one, ascending, shape [n]."""
        self.pose_topic: str | None = poses.topic.name if poses else None
        self.poses: PoseTrack | None = poses.track.shifted(float(times[0] - start) * 1e-9) if poses else None
        """Motion of the body, or None where nothing was recorded."""
        self.extrinsic: Transform = poses.extrinsic if poses else IDENTITY
        """Position [m] and quaternion of the sensor in the body frame."""

    @property
    def damage(self) -> str | None:
        """In one sentence which playable sweeps turned out to be unreadable so far; None while there are none."""
        if not self.damaged_sweeps:
            return None
        counts = f"{len(self.damaged_sweeps)} of {len(self._entries)} sweeps"
        return f"{counts} could not be read and played without points: {_ranges(sorted(self.damaged_sweeps))}."

    def sweep(self, index: int) -> PointSweep:
        """Return playable sweep `index`; the last few are kept. An unreadable one comes back without points."""
        if index in self._cache:
            self._cache.move_to_end(index)
            return self._cache[index]
        entry = self._entries[index]
        try:
            data = entry.file.read(entry.position)
            layout = cloud_layout(data, len(data), self._kind, self._encoding)
            points, times, dropped = decode_cloud(data, layout)
        except Exception:  # decompressors and SQLite fail in many ways; one bad sweep must not end the playback
            points, times, dropped = np.empty((0, 3), np.float32), None, entry.count
            self.damaged_sweeps.add(index)
        position, quaternion = self.extrinsic
        if self.extrinsic is not IDENTITY:
            points = points @ rotation_matrix(quaternion).T.astype(np.float32) + position.astype(np.float32)
        sweep = PointSweep(float(self.sweep_times[index]), points, times, dropped)
        self._cache[index] = sweep
        if len(self._cache) > _CACHED_SWEEPS:
            self._cache.popitem(last=False)
        return sweep

    def close(self) -> None:
        """Close the files."""
        self._cache.clear()
        self._storage.close()

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def open_recording(path: str | Path, *, points_topic: str | None = None, pose_topic: str | None = None) -> Recording:
    """Open an MCAP file, a rosbag2 folder, a .db3 file or a ROS 1 bag.

    The clouds are those of the busiest cloud topic; the poses are the first of Odometry, PoseStamped,
    PoseWithCovarianceStamped, TransformStamped and TF that overlaps the sweeps. Both can be named instead. One pass
    over the file reads the poses and notes where the sweeps are; sweeps are read when asked for.

    Raises UserError for anything that keeps the recording from being played.
    """
    storage = open_storage(path)
    try:
        with readable(storage.path):
            return Recording(storage, read_contents(storage), points_topic, pose_topic)
    except BaseException:
        storage.close()
        raise


def require_topics(contents: Contents, *, points_topic: str | None, pose_topic: str | None) -> None:
    """Raise UserError when a topic that is named is not there or of the wrong type; None names none."""
    for name, role in ((points_topic, "points"), (pose_topic, "pose")):
        if name is not None:
            _named(contents, name, role)


def _cloud_topic(contents: Contents, name: str | None) -> TopicContents:
    topics = sorted(contents.of_types(CLOUD_TYPES), key=lambda topic: (-len(topic.clouds), topic.name))
    if name is not None:
        topics = [_named(contents, name, "points")]
    if not topics:
        held = ", ".join(f"{topic.name} ({topic.type or 'no type'})" for topic in contents.topics) or "no topics"
        raise UserError(f"{contents.path} has no PointCloud2 topic with messages; it holds {held}")
    if not topics[0].clouds:
        reason = topics[0].reason or "there are no messages"
        raise UserError(f"no cloud on {topics[0].name} of {contents.path} can be read: {reason}")
    return topics[0]


def _pose_topics(contents: Contents, frame: str, name: str | None) -> list[TopicContents]:
    if name is not None:
        return [_named(contents, name, "pose")]
    topics = [topic for topic in contents.of_types(POSE_TYPES) if len(topic.poses)]
    moving = contents.transforms.track(frame, stamped=True) is not None
    return topics + (contents.of_types(TF_TYPES)[:1] if moving else [])


def _times(entries: list[CloudEntry], *, stamped: bool) -> NDArray[np.int64]:
    return np.array([entry.time if stamped else entry.arrival for entry in entries], np.int64)


def _choose_poses(
    contents: Contents, entries: list[CloudEntry], name: str | None
) -> tuple[_Poses | None, bool, NDArray[np.bool_]]:
    """Return the first poses that cover half of the sweeps, else those that cover most; by stamps, else by arrival.

    With them: whether stamps are used, and which sweeps are covered. None when no poses are recorded; raises UserError
    when there are some and they cover no sweep.
    """
    frame, start = entries[0].frame, entries[0].time
    candidates = _pose_topics(contents, frame, name)
    if not candidates:
        return None, True, np.ones(len(entries), np.bool_)
    best: tuple[_Poses | None, bool, NDArray[np.bool_]] = (None, True, np.zeros(len(entries), np.bool_))
    for stamped in (True, False):
        times = (_times(entries, stamped=stamped) - start) * 1e-9
        for topic in candidates:
            poses = _build_track(contents, topic, frame, start, stamped=stamped)
            if poses is None:
                continue
            covered = poses.track.covers(times)
            if covered.sum() > best[2].sum():
                best = (poses, stamped, covered)
            if best[2].mean() >= 0.5:
                return best
    if best[0] is None:
        names = " and ".join(topic.name for topic in candidates)
        raise UserError(
            f"the poses on {names} of {contents.path} do not overlap the sweeps in time: "
            "record both together or name another topic with pose_topic"
        )
    return best


def _build_track(contents: Contents, topic: TopicContents, frame: str, start: int, *, stamped: bool) -> _Poses | None:
    if topic.type in TF_TYPES:
        moved = contents.transforms.track(frame, stamped=stamped)
        if moved is None:
            return None
        extrinsic, times, positions, quaternions, _ = moved
        return _Poses(topic, PoseTrack.build((times - start) * 1e-9, positions, quaternions), extrinsic, "")
    if not len(topic.poses):
        return None
    rows = topic.poses.rows()
    times = (topic.poses.times(stamped=stamped) - start) * 1e-9
    track = PoseTrack.build(times, rows[:, :3], rows[:, 3:7], rows[:, 7:])
    if not topic.child or topic.child == frame:
        return _Poses(topic, track, IDENTITY, "")
    extrinsic = contents.transforms.between(topic.child, frame)
    notice = "" if extrinsic else (
        f"poses on {topic.name} are of {topic.child!r}, clouds are in {frame!r} and no static transform joins them: "
        "they are taken to be the same frame"
    )  # fmt: skip
    return _Poses(topic, track, extrinsic or IDENTITY, notice)


def _named(contents: Contents, name: str, role: str) -> TopicContents:
    types, lack = _ROLES[role]
    fitting = contents.of_types(types)
    found = [topic for topic in contents.topics if topic.name == name]
    if not found:
        close = difflib.get_close_matches(name, [topic.name for topic in fitting], n=3, cutoff=0.4)
        advice = f"; did you mean {' or '.join(close)}?" if close else _offer(fitting) or ", nor any other"
        raise UserError(f"{contents.path} has no {role} topic {name}{advice}")
    topic = max(found, key=lambda topic: (topic.type in types, topic.count))
    if topic.type not in types:
        raise UserError(f"{name} of {contents.path} is a {topic.type}, {lack}{_offer(fitting)}")
    return topic


def _others(contents: Contents, topic: TopicContents) -> str:
    """Advice for a topic that is of no use."""
    others = [other for other in contents.of_types(CLOUD_TYPES) if other is not topic]
    return _offer(others) or ": look whether the driver publishes the sensor's points there"


def _offer(topics: Sequence[TopicContents]) -> str:
    return f"; choose {' or '.join(topic.name for topic in topics)}" if topics else ""


def _ranges(indices: Iterable[int]) -> str:
    """Return 0..3, 7 for 0, 1, 2, 3, 7."""
    runs: list[list[int]] = []
    for index in indices:
        if runs and index == runs[-1][1] + 1:
            runs[-1][1] = int(index)
        else:
            runs.append([int(index), int(index)])
    words = [str(first) if first == last else f"{first}..{last}" for first, last in runs]
    return ", ".join(words[:6]) + (f" and {len(words) - 6} more runs" if len(words) > 6 else "")
