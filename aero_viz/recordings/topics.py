"""The choice of the topics that a recording is played from."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_viz.errors import UserError
from aero_viz.recordings.clouds import CLOUD_TYPES
from aero_viz.recordings.contents import CloudEntry, Contents, TopicContents
from aero_viz.recordings.depth_image import IMAGE
from aero_viz.recordings.imu_messages import IMU_TYPE
from aero_viz.recordings.other_clouds import LASER_SCAN
from aero_viz.recordings.pose_messages import POSE_TYPES
from aero_viz.recordings.poses import SPEED_MAX, RecordedPoses
from aero_viz.recordings.ros_messages import TF_TYPES
from aero_viz.recordings.transforms import FIXED_FRAMES, IDENTITY, PoseSamples, Transform
from aero_viz.recordings.velodyne_scan import VELODYNE_SCAN

Array = NDArray[np.float64]

_ROLES = {
    "points": (CLOUD_TYPES, "not a point cloud"),
    "pose": ((*POSE_TYPES, *TF_TYPES), "which holds no poses"),
    "IMU": ((IMU_TYPE,), "which holds no angular velocities"),
}
"""Types of messages that fit each role of a topic, and the complaint about any other type."""

_UNREAD = {
    r"/(PacketMsg|UdpFrame|(rslidar|pandar|lslidar)Scan|\w+Packets?)$": (
        "record the clouds that the sensor's driver makes while it replays the packets"
    ),
    r"[/.]CompressedPointCloud2?$": (
        "decompress its clouds with `ros2 run point_cloud_transport republish`, and record their PointCloud2 topic"
    ),
}
"""Advice for types of messages whose points cannot be read: packets and compressed clouds."""

_SHOWN, _SHOWN_LENGTH = 8, 80
"""Number of names that a message lists, and their length."""

_FARTHEST_POSE = 1e5
"""Distance from the median position along an axis [m] beyond which a pose is damaged."""

_TRACKS = 16
"""Number of frames on one topic whose poses are tried."""

_IN_WORLD = "clouds are in the frame of the world, {frame!r}: the poses on {topic} move them to the body"

_SUFFICIENT_COVERAGE = 0.5
"""Share of the sweeps that poses must cover for the search to end with them."""


class PoseSource(NamedTuple):
    """The poses of one topic."""

    topic: str
    poses: RecordedPoses
    """Time in seconds from the first sweep."""
    extrinsic: Transform
    """Pose of the LiDAR in the body's frame."""
    body: str
    """Frame of the body."""
    is_joined: bool
    """True if the recording says where the LiDAR is in the body's frame; else the two are assumed to be the same."""
    notice: str
    """Notice for the user about the extrinsic; empty if there is nothing to say."""
    in_world: bool = False
    """True if the clouds are in the frame that the poses are in."""
    world: str = ""
    """Frame that the poses are in; empty where it is not known."""
    type: str = ""
    """Type of the messages."""


class _Track(NamedTuple):
    """Poses of one frame in another one."""

    topic: TopicContents
    parent: str
    """Frame that the poses are in."""
    child: str
    """Frame that they place; empty where the messages do not say."""
    samples: PoseSamples
    """Empty for a topic of transforms."""


class ChosenPoses(NamedTuple):
    """The poses to play a recording with."""

    source: PoseSource | None
    """None if no poses are recorded."""
    stamped: bool
    """True if sweeps and poses are matched by their stamps, False if by their times of recording."""
    covered: NDArray[np.bool_]
    """[n], True for the sweeps that have a pose."""
    notice: str = ""
    """Notice for the user about recorded transforms that cannot be used; empty if there is nothing to say."""


def require_topics(contents: Contents, *, points_topic: str | None, pose_topic: str | None) -> None:
    """Check that the topics the user named exist and are of the right type; None names no topic.

    Raises:
        UserError: they are not.
    """
    for name, role in ((points_topic, "points"), (pose_topic, "pose")):
        if name is not None:
            _find_topic(contents, name, role)


def choose_cloud_topic(contents: Contents, name: str | None) -> tuple[TopicContents, str]:
    """Return the topic with the sweeps, the named one or the one with the most points, and a notice on the others.

    Clouds that are already in the frame of the world come last, before them planar scans and depth images, and before
    these single clouds, which may be maps, and packets, which may be those of another topic.

    Raises:
        UserError: there is no such topic or none of its clouds can be read.
    """
    worlds = {parent for topic in contents.topics for parent, _ in topic.poses if parent}.union(FIXED_FRAMES)

    def order(topic: TopicContents) -> tuple[bool, bool, bool, int, str]:
        placed = any(cloud.frame in worlds for cloud in topic.clouds[:1])
        return (
            placed,
            topic.type in (LASER_SCAN, IMAGE),
            len(topic.clouds) < 2 or topic.type == VELODYNE_SCAN,
            -_points(topic),
            topic.name,
        )

    found = contents.topics_with(CLOUD_TYPES)
    topics = sorted((topic for topic in found if topic.type != IMAGE or topic.clouds or topic.damaged), key=order)
    others = [topic for topic in topics[1:] if topic.clouds]
    notice = ""
    if name is not None:
        topics = [_find_topic(contents, name, "points")]
    elif others:
        seconds = max(contents.duration, 1e-3)
        rates = [f"{topic.name} ({_points(topic) / seconds:.0f} points a second)" for topic in (topics[0], *others)]
        notice = (
            f"of {len(rates)} topics of clouds, {rates[0]} is played; --points-topic plays {_join(rates[1:], ', ')}"
        )
    if not topics:
        held = _join([f"{topic.name} ({topic.type or 'no type'})" for topic in contents.topics], ", ") or "no topics"
        present = [topic.type for topic in contents.topics if topic.count]
        advice = (text for kind, text in _UNREAD.items() if any(re.search(kind, name, re.I) for name in present))
        raise UserError(
            f"{contents.path} has no PointCloud2 topic with messages, nor any other cloud that can be read; it holds "
            f"{held}: {next(advice, 'record the topic of the LiDAR, too')}."
        )
    if not topics[0].clouds:
        reason = topics[0].reason or "there are no messages"
        raise UserError(f"No cloud on {topics[0].name} of {contents.path} can be read: {reason}.")
    return topics[0], notice


def _points(topic: TopicContents) -> int:
    return sum(cloud.count for cloud in topic.clouds)


def choose_poses(
    contents: Contents, entries: list[CloudEntry], name: str | None, *, use_stamps: bool = True
) -> ChosenPoses:
    """Return the first poses that cover half of the sweeps, or else those that cover the most.

    All topics are tried with stamps before any is tried with times of recording.

    Args:
        contents: the recording.
        entries: its sweeps, at least one.
        name: topic of the poses; None tries all topics, first those whose frame is known to be joined to the clouds',
            and those in the order of preference of their types.
        use_stamps: False for entries whose stamps cannot be used: only times of recording are tried.

    Raises:
        UserError: the named topic has no poses, or there are poses, but they cover no sweep.
    """
    frame, start = entries[0].frame, entries[0].time if use_stamps else entries[0].arrival
    candidates = _pose_tracks(contents, frame, name)
    if not candidates and name is not None:
        raise UserError(
            f"{name} of {contents.path} has no pose that can be used: record it again, or name another topic."
        )
    if not candidates:
        moving = [repr(name) for name in contents.transforms.moving_frames()]
        notice = (
            f"TF moves {_join(moving, ', ')}, but no transforms join that to {frame!r}, the frame of the clouds: "
            "record /tf_static, too"
        )
        return ChosenPoses(None, use_stamps, np.ones(len(entries), np.bool_), notice if moving else "")
    best = ChosenPoses(None, True, np.zeros(len(entries), np.bool_))
    for stamped in (True, False) if use_stamps else (False,):
        sweep_times = np.array([entry.time if stamped else entry.arrival for entry in entries], np.int64)
        for track in candidates:
            source = _read_poses(contents, track, frame, start, stamped=stamped)
            if source is None:
                continue
            covered = source.poses.covers((sweep_times - start) * 1e-9)
            if covered.sum() > best.covered.sum():
                best = ChosenPoses(source, stamped, covered)
            if best.covered.mean() >= _SUFFICIENT_COVERAGE:
                return best
    if best.source is None:
        names = _join(list(dict.fromkeys(track.topic.name for track in candidates)), " and ")
        raise UserError(
            f"The poses on {names} of {contents.path} do not overlap the sweeps in time: "
            "record both together or name another topic with pose_topic."
        )
    return best


def suggest_other_clouds(contents: Contents, topic: TopicContents) -> str:
    """Return advice, to be appended to an error, for a topic whose clouds cannot be used."""
    alternatives = [candidate for candidate in contents.topics_with(CLOUD_TYPES) if candidate is not topic]
    names = [topic.name for topic in alternatives]
    return _suggest(names) or ": check that the driver publishes the sensor's points there"


def _pose_tracks(contents: Contents, frame: str, name: str | None) -> list[_Track]:
    """Return the poses to try, the preferred ones first."""
    if name is None:
        topics = contents.topics_with(POSE_TYPES)
        moving = contents.transforms.moving_body(frame, stamped=True) is not None
        topics += contents.topics_with(TF_TYPES)[:1] if moving else []
    else:
        topics = [_find_topic(contents, name, "pose")]
    tracks = []
    for topic in topics:
        if topic.type in TF_TYPES:
            tracks.append(_Track(topic, "", "", PoseSamples()))
        else:
            busiest = sorted(topic.poses.items(), key=lambda item: -len(item[1]))[:_TRACKS]
            tracks += [_Track(topic, *frames, samples) for frames, samples in busiest]
    return sorted(tracks, key=lambda track: not _is_joined(contents, track, frame))


def _is_joined(contents: Contents, track: _Track, frame: str) -> bool:
    """Return True if the recording says where `frame` is in the frames of the poses."""
    if track.topic.type in TF_TYPES or frame in (track.child, track.parent):
        return True
    return bool(track.child) and contents.transforms.between(track.child, frame) is not None


def _read_poses(contents: Contents, track: _Track, frame: str, start: int, *, stamped: bool) -> PoseSource | None:
    """Return poses, or None if there are none.

    Args:
        contents: the recording.
        track: where they are in it.
        frame: frame of the clouds.
        start: time zero [ns].
        stamped: True for the poses' stamps, False for their times of recording.
    """
    name = track.topic.name
    if track.topic.type in TF_TYPES:
        body = contents.transforms.moving_body(frame, stamped=stamped)
        if body is None:
            return None
        poses, notice = _without_outliers(name, np.asarray((body.times - start) * 1e-9, np.float64), *body.poses)
        in_world = _IN_WORLD.format(frame=frame, topic=name) if body.in_world else ""
        text = "; ".join(filter(None, (notice, in_world)))
        frames = (body.in_world, body.world, track.topic.type)
        return PoseSource(name, poses, body.extrinsic, body.frame, True, text, *frames)
    rows = track.samples.rows()
    times = np.asarray((track.samples.times(stamped=stamped) - start) * 1e-9, np.float64)
    poses, outliers = _without_outliers(name, times, rows[:, :3], rows[:, 3:7], rows[:, 7:])
    extrinsic, notice, in_world, is_joined = IDENTITY, "", False, True
    body = track.child or contents.transforms.carrier(frame, world=track.parent)
    if track.parent == frame != track.child:
        notice, in_world = _IN_WORLD.format(frame=frame, topic=name), True
    elif body != frame:
        joined = contents.transforms.between(body, frame)
        extrinsic, is_joined = joined or IDENTITY, joined is not None
        if not track.child:
            notice = (
                f"poses on {name} do not name their frame: they are taken for those of {body!r}, which carries "
                f"{frame!r} by /tf_static"
            )
        elif joined is None:
            notice = (
                f"poses on {name} are those of {body!r}, clouds are in {frame!r}, and no static transform joins the "
                "two: they are assumed to be the same frame"
            )
    text = "; ".join(filter(None, (_other_tracks(track), outliers, notice)))
    return PoseSource(name, poses, extrinsic, body, is_joined, text, in_world, track.parent, track.topic.type)


def _other_tracks(track: _Track) -> str:
    """Return a notice that a topic has also poses between other frames than those that are used, empty if not."""
    if len(track.topic.poses) < 2:
        return ""
    others = [f"{child!r} in {parent!r}" for parent, child in track.topic.poses if (parent, child) != track[1:3]]
    total = sum(len(samples) for samples in track.topic.poses.values())
    return (
        f"{track.topic.name} holds poses of several frames: {len(track.samples)} of {total}, those of {track.child!r} "
        f"in {track.parent!r}, are used, and not those of {_join(others, ', ')}"
    )


def _without_outliers(
    name: str, times: Array, positions: Array, quaternions: Array, velocities: Array | None = None
) -> tuple[RecordedPoses, str]:
    """Return the poses near the median position, and a notice about outliers and jumps, empty if there are none.

    Args:
        name: topic.
        times, positions, quaternions, velocities: see `RecordedPoses`.
    """
    distance = np.abs(positions - np.median(positions, axis=0)).max(axis=1)
    if distance.min() > _FARTHEST_POSE:  # two places that are far apart: keep the first one
        distance = np.abs(positions - positions[0]).max(axis=1)
    near = distance <= _FARTHEST_POSE
    twists = None if velocities is None else velocities[near]
    poses = RecordedPoses(times[near], positions[near], quaternions[near], twists)
    notices = []
    if not near.all():
        notices.append(
            f"{len(near) - int(near.sum())} of {len(near)} poses on {name} are left out: they lie more than "
            f"{_FARTHEST_POSE / 1e3:g} km from the others"
        )
    if poses.jumps:
        notices.append(f"the positions on {name} jump {poses.jumps} times, faster than {SPEED_MAX:g} m/s")
    return poses, "; ".join(notices)


def _find_topic(contents: Contents, name: str, role: str) -> TopicContents:
    """Return the named topic. Raises UserError if it does not exist or does not fit the role."""
    types, _ = _ROLES[role]
    found = [topic for topic in contents.topics if topic.name == name]
    present = [(topic.name, topic.type) for topic in (*contents.topics_with(types), *found)]
    check_topic(name, role, present, str(contents.path))
    return max(found, key=lambda topic: (topic.type in types, topic.count))


def check_topic(name: str, role: str, present: Sequence[tuple[str, str]], place: str) -> None:
    """Check that a topic exists and is of the right type.

    Args:
        name: the topic.
        role: "points", "pose" or "IMU".
        present: the topics to choose from and their types, the preferred ones first.
        place: where they are, for the error.

    Raises:
        UserError: it is not.
    """
    types, mismatch = _ROLES[role]
    suitable = [topic for topic, kind in present if kind in types]
    kinds = [kind for topic, kind in present if topic == name]
    if not kinds:
        close = difflib.get_close_matches(name, suitable, n=3, cutoff=0.4)
        advice = f"; did you mean {' or '.join(close)}?" if close else f"{_suggest(suitable) or ', nor any other'}."
        raise UserError(f"{place} has no {role} topic {name}{advice}")
    if name not in suitable:
        raise UserError(f"{name} of {place} is a {kinds[0]}, {mismatch}{_suggest(suitable)}.")


def _suggest(names: list[str]) -> str:
    return f"; choose {_join(names, ' or ')}" if names else ""


def _join(names: list[str], separator: str) -> str:
    """Return the first names as one text, and how many more there are."""
    shown = separator.join(
        name if len(name) <= _SHOWN_LENGTH else f"{name[:_SHOWN_LENGTH]}.." for name in names[:_SHOWN]
    )
    return shown + (f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else "")
