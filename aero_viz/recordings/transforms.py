"""ROS's tree of frames (TF): the pose of a sensor from a chain of transforms."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_planner.pose_track import PoseTrack
from aero_planner.quaternions import compose_transforms, invert_transform, rotation_matrix
from aero_viz.recordings.poses import sort_poses

FIXED_FRAMES = ("map", "world", "odom", "camera_init")
"""Names of frames that do not move, the preferred one first."""


class Transform(NamedTuple):
    """Pose of a frame in another one."""

    position: NDArray[np.float64]
    """[.., 3] [m]."""
    quaternion: NDArray[np.float64]
    """[.., 4] w, x, y, z."""

    def move(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return points in the frame [m], [P, 3], in the other one."""
        return points @ rotation_matrix(self.quaternion).astype(np.float32).T + self.position.astype(np.float32)


IDENTITY = Transform(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))


class MovingBody(NamedTuple):
    """The motion of the body that carries a sensor."""

    extrinsic: Transform
    """Pose of the sensor in the body's frame."""
    times: NDArray[np.int64]
    """[n] [ns]."""
    poses: Transform
    """Poses of the body in the fixed frame."""
    frame: str
    """Name of the body's frame."""
    world: str
    """Name of the fixed frame."""
    in_world: bool = False
    """True if the clouds are in the fixed frame."""


def matrix_of(position: NDArray[np.float64], quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a pose as a matrix [4, 4]."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation_matrix(quaternion), position
    return matrix


@dataclass
class PoseSamples:
    """A growing list of stamped poses, 96 bytes each."""

    stamps: array[int] = field(default_factory=lambda: array("q"))
    """Times in the headers [ns], 0 where unset."""
    arrivals: array[int] = field(default_factory=lambda: array("q"))
    """Times of recording [ns]."""
    values: array[float] = field(default_factory=lambda: array("d"))
    """Position [m], quaternion (w, x, y, z), velocity [m/s]: ten numbers per pose."""

    def add(self, stamp: int, arrival: int, values: tuple[float, ...]) -> None:
        """Append a pose."""
        self.stamps.append(stamp)
        self.arrivals.append(arrival)
        self.values.extend(values)

    def __len__(self) -> int:
        return len(self.stamps)

    def times(self, *, stamped: bool) -> NDArray[np.int64]:
        """Return times [n] [ns]: the stamps, where set, if `stamped` is True, else the times of recording."""
        arrivals = np.array(self.arrivals, np.int64)
        stamps = np.array(self.stamps, np.int64)
        return np.where(stamps != 0, stamps, arrivals) if stamped else arrivals

    def rows(self) -> NDArray[np.float64]:
        """Return position, quaternion and velocity [n, 10]."""
        return np.array(self.values, float).reshape(-1, 10)


@dataclass
class TransformTree:
    """The transforms recorded on /tf and /tf_static. An edge is a pair of names (parent, child)."""

    _edges: dict[str, dict[str, PoseSamples]] = field(default_factory=dict, init=False)
    """By child and parent."""
    _static: set[tuple[str, str]] = field(default_factory=set, init=False)

    def add(self, parent: str, child: str, stamp: int, arrival: int, pose: tuple[float, ...], *, static: bool) -> None:
        """Add a transform: position and quaternion of `child` in `parent`."""
        samples = self._edges.setdefault(child, {}).setdefault(parent, PoseSamples())
        samples.add(stamp, arrival, (*pose, 0.0, 0.0, 0.0))
        if static:
            self._static.add((parent, child))

    def chain(self, frame: str) -> list[tuple[str, str]]:
        """Return the edges from `frame` up to the preferred fixed frame or, without one, up to the root."""
        edges: list[tuple[str, str]] = []
        seen = {frame}
        while frame in self._edges:
            # If two publishers disagree on the parent, the busier one is the localization.
            parent = max(self._edges[frame], key=lambda name: len(self._edges[frame][name]))
            if parent in seen:
                break
            edges.append((parent, frame))
            seen.add(parent)
            frame = parent
        for fixed in FIXED_FRAMES:
            for length, (parent, _) in enumerate(edges, 1):
                if parent == fixed:
                    return edges[:length]
        return edges

    def is_static(self, edge: tuple[str, str]) -> bool:
        """Return True for a transform that was published on /tf_static or repeated unchanged."""
        rows = self._samples(edge).rows()
        return edge in self._static or bool((rows == rows[0]).all() and len(rows) > 1)

    def moving_frames(self) -> list[str]:
        """Return the names of the frames that move in another one."""
        return [child for child, parents in self._edges.items() if any(not self.is_static((p, child)) for p in parents)]

    def between(self, target: str, source: str) -> Transform | None:
        """Return the static pose of frame `source` in frame `target`, or None if no static edges join them."""
        from_source, from_target = self._static_chain(source), self._static_chain(target)
        for frame, transform in from_source.items():
            if frame in from_target:
                return Transform(*compose_transforms(*invert_transform(*from_target[frame]), *transform))
        return None

    def carrier(self, frame: str, *, world: str) -> str:
        """Return the topmost frame that `frame` is rigidly joined to, other than `world` and the fixed frames."""
        carriers = [name for name in self._static_chain(frame) if name not in (*FIXED_FRAMES, world)]
        return carriers[-1] if carriers else frame

    def moving_body(self, frame: str, *, stamped: bool) -> MovingBody | None:
        """Return the motion of the body that carries `frame`, or None if no transform moves it.

        The static edges next to the sensor are its extrinsic. The first moving edge moves the body. A frame of the
        world carries no sensor; the body is then the first one that moves in it.
        """
        edges, extrinsic = self.moving_edges(frame)
        if not edges:
            return None
        followed = self._follow(edges, stamped=stamped)
        return MovingBody(extrinsic, *followed, edges[0][1], edges[-1][0], in_world=frame in FIXED_FRAMES)

    def moving_edges(self, frame: str) -> tuple[list[tuple[str, str]], Transform]:
        """Return the edges from the body that carries `frame` up to the fixed frame, and the pose of `frame` in it.

        The list is empty if no transform moves the body.
        """
        if frame in FIXED_FRAMES:
            return self._edges_into(frame), IDENTITY
        edges, extrinsic = self.chain(frame), IDENTITY
        while edges and self.is_static(edges[0]):
            extrinsic = Transform(*compose_transforms(*self._constant(edges[0]), *extrinsic))
            edges = edges[1:]
        return edges, extrinsic

    def _edges_into(self, world: str) -> list[tuple[str, str]]:
        """Return the edges from the busiest body that moves in a frame of the world up to that frame, if there is one.

        Between the body and that frame there are only frames of the world, such as odom.
        """
        bodies = [
            (parent, child)
            for child, parents in self._edges.items()
            for parent in parents
            if parent in FIXED_FRAMES and child not in FIXED_FRAMES and not self.is_static((parent, child))
        ]
        for edge in sorted(bodies, key=lambda edge: -len(self._samples(edge))):
            edges, seen = [edge], {edge[1]}
            while edges[-1][0] != world and edges[-1][0] not in seen:
                seen.add(edges[-1][0])
                above = self._edges.get(edges[-1][0], {})
                if not above:
                    break
                edges.append((max(above, key=lambda name: len(above[name])), edges[-1][0]))
            if edges[-1][0] == world:
                return edges
        return []

    def _follow(self, edges: list[tuple[str, str]], *, stamped: bool) -> tuple[NDArray[np.int64], Transform]:
        """Return the times of the first edge [n] [ns], and the poses of its child in the parent of the last one."""
        times = np.unique(self._samples(edges[0]).times(stamped=stamped))
        poses = self._interpolated(edges[0], times, stamped=stamped)
        for edge in edges[1:]:
            static = self.is_static(edge)
            parent = self._constant(edge) if static else self._interpolated(edge, times, stamped=stamped)
            poses = Transform(*compose_transforms(*parent, *poses))
        return times, poses

    def _static_chain(self, frame: str) -> dict[str, Transform]:
        """Return the frames above `frame` that are rigidly joined to it, with the pose of `frame` in each."""
        reached, transform = {frame: IDENTITY}, IDENTITY
        for edge in self.chain(frame):
            if not self.is_static(edge):
                break
            transform = Transform(*compose_transforms(*self._constant(edge), *transform))
            reached[edge[0]] = transform
        return reached

    def _samples(self, edge: tuple[str, str]) -> PoseSamples:
        parent, child = edge
        return self._edges[child][parent]

    def _constant(self, edge: tuple[str, str]) -> Transform:
        row = self._samples(edge).rows()[-1]
        return Transform(row[:3], row[3:7])

    def _interpolated(self, edge: tuple[str, str], times: NDArray[np.int64], *, stamped: bool) -> Transform:
        """Return the transform at `times`, constant before its first and after its last sample.

        It is constant for long, because map -> odom is published rarely.
        """
        samples = self._samples(edge)
        seconds = (samples.times(stamped=stamped) - times[0]) * 1e-9
        rows = samples.rows()
        _, *poses = sort_poses(seconds, rows[:, :3], rows[:, 3:7])
        return Transform(*PoseTrack.from_arrays(*poses).interpolate((times - times[0]) * 1e-9))
