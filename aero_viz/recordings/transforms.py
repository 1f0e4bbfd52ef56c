"""ROS's tree of frames (TF): the pose of a sensor from a chain of transforms."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from aero_planner.quaternions import compose_transforms, invert_transform, slerp
from aero_viz.recordings.poses import PoseTrack

__all__ = ["FIXED_FRAMES", "Samples", "TransformTree"]

FIXED_FRAMES = ("map", "world", "odom")
"""Names of frames that do not move, the preferred one first."""

Transform = tuple[NDArray[np.float64], NDArray[np.float64]]
IDENTITY: Transform = (np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))


@dataclass
class Samples:
    """A growing list of stamped poses, 96 bytes each."""

    stamps: array = field(default_factory=lambda: array("q"))
    """In the header [ns], 0 where unset."""
    arrivals: array = field(default_factory=lambda: array("q"))
    """When they were recorded [ns]."""
    values: array = field(default_factory=lambda: array("d"))
    """Position [m], quaternion w, x, y, z, velocity [m/s]: ten numbers each."""

    def add(self, stamp: int, arrival: int, values: tuple[float, ...]) -> None:
        """Append one pose."""
        self.stamps.append(stamp)
        self.arrivals.append(arrival)
        self.values.extend(values)

    def __len__(self) -> int:
        return len(self.stamps)

    def times(self, *, stamped: bool) -> NDArray[np.int64]:
        """Return times [ns], shape [n]: of the header (of arrival where it has none) or all of arrival."""
        arrivals = np.array(self.arrivals, np.int64)
        stamps = np.array(self.stamps, np.int64)
        return np.where(stamps != 0, stamps, arrivals) if stamped else arrivals

    def rows(self) -> NDArray[np.float64]:
        """Return position, quaternion and velocity, shape [n, 10]."""
        return np.array(self.values, float).reshape(-1, 10)


class TransformTree:
    """Transforms parent <- child as recorded on /tf and /tf_static."""

    def __init__(self) -> None:
        self._edges: dict[str, dict[str, Samples]] = {}
        self._static: set[tuple[str, str]] = set()

    def add(self, parent: str, child: str, stamp: int, arrival: int, pose: tuple[float, ...], *, static: bool) -> None:
        """Add one transform: position and quaternion of `child` in `parent`."""
        self._edges.setdefault(child, {}).setdefault(parent, Samples()).add(stamp, arrival, (*pose, 0.0, 0.0, 0.0))
        if static:
            self._static.add((parent, child))

    def chain(self, frame: str) -> list[tuple[str, str]]:
        """Return the edges (parent, child) from `frame` up to the preferred fixed frame, else up to the root."""
        edges: list[tuple[str, str]] = []
        seen = {frame}
        while frame in self._edges:
            # Two publishers may disagree on the parent; the busier one is the one that localises.
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
        """Return True for a transform of /tf_static, or one that is repeated unchanged."""
        rows = self._samples(edge).rows()
        return edge in self._static or bool((rows == rows[0]).all() and len(rows) > 1)

    def between(self, target: str, source: str) -> Transform | None:
        """Return the static transform source -> target, or None where no static edges join the two frames."""
        down, up = self._static_chain(source), self._static_chain(target)
        for frame, transform in down.items():
            if frame in up:
                return compose_transforms(*invert_transform(*up[frame]), *transform)
        return None

    def track(self, frame: str, *, stamped: bool) -> tuple[Transform, NDArray[np.int64], NDArray, NDArray, str] | None:
        """Return the motion of what carries `frame`, or None where no transform moves it.

        The static edges next to the sensor are its extrinsic; the first moving edge moves the body. Returned are the
        extrinsic (sensor in body), times [ns] (n,), positions (n, 3) and quaternions (n, 4) of the body, and its name.
        """
        edges, extrinsic = self.chain(frame), IDENTITY
        while edges and self.is_static(edges[0]):
            extrinsic = compose_transforms(*self._constant(edges[0]), *extrinsic)
            edges = edges[1:]
        if not edges:
            return None
        times = np.unique(self._samples(edges[0]).times(stamped=stamped))
        position, quaternion = self._interpolated(edges[0], times, stamped=stamped)
        for edge in edges[1:]:
            if self.is_static(edge):
                position, quaternion = compose_transforms(*self._constant(edge), position, quaternion)
            else:
                position, quaternion = compose_transforms(
                    *self._interpolated(edge, times, stamped=stamped), position, quaternion
                )
        return extrinsic, times, position, quaternion, edges[0][1]

    def _static_chain(self, frame: str) -> dict[str, Transform]:
        """Return the frames that `frame` is rigidly joined to upwards, with the transforms frame -> them."""
        reached, transform = {frame: IDENTITY}, IDENTITY
        for edge in self.chain(frame):
            if not self.is_static(edge):
                break
            transform = compose_transforms(*self._constant(edge), *transform)
            reached[edge[0]] = transform
        return reached

    def _samples(self, edge: tuple[str, str]) -> Samples:
        return self._edges[edge[1]][edge[0]]

    def _constant(self, edge: tuple[str, str]) -> Transform:
        row = self._samples(edge).rows()[-1]
        return row[:3], row[3:7]

    def _interpolated(self, edge: tuple[str, str], times: NDArray[np.int64], *, stamped: bool) -> Transform:
        """Return the edge at `times`, held before its first and after its last sample: map -> odom is sent rarely."""
        samples = self._samples(edge)
        own = samples.times(stamped=stamped)
        track = PoseTrack.build((own - times[0]) * 1e-9, samples.rows()[:, :3], samples.rows()[:, 3:7])
        t = np.clip((times - times[0]) * 1e-9, track.times[0], track.times[-1])
        after = np.clip(np.searchsorted(track.times, t), 1, max(len(track.times) - 1, 1)) % len(track.times)
        before = np.maximum(after - 1, 0)
        span = track.times[after] - track.times[before]
        fraction = np.where(span > 0, (t - track.times[before]) / np.where(span > 0, span, 1.0), 0.0)
        f = fraction[:, None]
        position = (1 - f) * track.positions[before] + f * track.positions[after] + track.offset
        return position, slerp(track.quaternions[before], track.quaternions[after], fraction)
