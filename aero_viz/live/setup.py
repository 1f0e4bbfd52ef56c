"""What is assumed about a stream: its topics, frames, times and mounting, found as for a recording, and its faults."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from aero_viz.live.stream import Stream
from aero_viz.recordings.axes import other_axes
from aero_viz.recordings.choices import Choices, CloudFrame
from aero_viz.recordings.contents import read_contents
from aero_viz.recordings.depth_image import Intrinsics
from aero_viz.recordings.finding import Finding
from aero_viz.recordings.findings import Measured, check_twists, find_faults, measure
from aero_viz.recordings.opening import check_mask, configure_recording, pose_of
from aero_viz.recordings.recording import Recording
from aero_viz.recordings.ros_messages import TF_TYPES
from aero_viz.recordings.topics import require_topics
from aero_viz.recordings.transforms import IDENTITY, Transform, TransformTree

_FAR = 1000.0
"""Distance of the first pose from the origin beyond which positions are counted from it [m]: float32 keeps less than a
millimetre farther out."""


@dataclass(frozen=True)
class Wanted:
    """What the user has settled about a stream; None is found.

    Raises:
        UserError: the pose of the sensor or the box is none.
    """

    points: str | None = None
    """Topic of the clouds."""
    odometry: str | None = None
    """Topic of the poses."""
    extrinsic: Sequence[float] | None = None
    """x, y, z [m] and roll, pitch, yaw [deg] of the sensor in the body's frame."""
    mask: Sequence[float] | None = None
    """Box in the body's frame whose points are left out, see `Recording.mask`."""
    frame: CloudFrame = "auto"
    """What the clouds move with."""

    def __post_init__(self) -> None:
        _ = self.mount
        if self.mask is not None:
            check_mask(self.mask)

    @property
    def mount(self) -> Transform:
        """Pose of the sensor in the body's frame, as far as it is settled."""
        return IDENTITY if self.extrinsic is None else pose_of(self.extrinsic, "--extrinsic")


@dataclass(frozen=True, eq=False)
class Setup:
    """How the messages of a stream become sweeps and states."""

    points: str
    """Topic of the clouds."""
    points_type: str
    poses: str | None
    """Topic of the poses; None for a sensor that stands still."""
    cloud_frame: str
    extrinsic: Transform
    """Pose of the sensor in the body's frame."""
    other_frames: dict[str, Transform]
    """Poses of other frames on the topic in `cloud_frame`."""
    in_world: bool
    """True if the clouds are in the frame of the poses."""
    stamped: bool
    """True if times are those of the stamps, False if they are those of arrival."""
    time_unit: float | None
    """Unit of the times of points [s]."""
    body: str
    """Frame that the poses place; empty where they do not say."""
    world: str
    """Frame that the poses are in; empty where it is unknown."""
    turn: NDArray[np.float64] | None
    """Quaternion from the body's axes to forward, left, up; None where they are so."""
    twist: Literal["body", "world", "none"]
    """Frame of the velocities, "none" where they are computed from the positions."""
    offset: NDArray[np.float64]
    """Position that is subtracted from all others [m], shape [3]."""
    mask: NDArray[np.float32] | None
    """Corners of a box whose points are left out, shape [2, 3]."""
    edges: tuple[tuple[str, str], ...]
    """Transforms (parent, child) from the body up to the world, for poses from TF."""
    camera: Intrinsics | None
    """Intrinsics of the camera of depth images."""
    used: tuple[str, ...]
    """Topics that are needed from now on."""
    assumptions: tuple[str, ...]
    """What was assumed, one sentence without a full stop each."""
    measured: Measured
    findings: tuple[Finding, ...] = ()


def find_setup(stream: Stream, wanted: Wanted, *, faults: bool = False) -> Setup:
    """Return how to read a stream, from the newest seconds of its messages.

    Args:
        stream: the messages.
        wanted: what is settled.
        faults: look for faults as `aero-viz inspect` does, which takes a second or more.

    Raises:
        UserError: there is no cloud, a topic has none, or no pose fits.
    """
    storage = stream.storage(Choices(cloud_frame=wanted.frame))
    try:
        contents = read_contents(storage)
        require_topics(contents, points_topic=wanted.points, pose_topic=wanted.odometry)
        recording = Recording(storage, contents, wanted.points, wanted.odometry)
        configure_recording(recording, storage, contents, extrinsic=wanted.extrinsic, mask=wanted.mask)
        findings = find_faults(recording) if faults else ()
        return _setup(recording, contents.transforms, wanted, tuple(findings))
    finally:
        storage.close()


def _setup(recording: Recording, transforms: TransformTree, wanted: Wanted, findings: tuple[Finding, ...]) -> Setup:
    source, poses = recording.pose_source, recording.poses
    edges: tuple[tuple[str, str], ...] = ()
    if source is not None and source.type in TF_TYPES:
        edges = tuple(transforms.moving_edges(recording.cloud_frame)[0])
    axes = None if source is None else other_axes(source.body)
    twist: Literal["body", "world", "none"] = "none"
    if poses is not None and poses.measured_velocity:
        twist = "world" if any(finding.code == "twist-frame" for finding in check_twists(poses)) else "body"
    offset = np.zeros(3) if poses is None or np.linalg.norm(poses.offset) < _FAR else poses.offset
    used = [recording.points_topic, *([source.topic] if source else [])]
    setup = Setup(
        points=recording.points_topic,
        points_type=recording.points_type,
        poses=None if source is None else source.topic,
        cloud_frame=recording.cloud_frame,
        extrinsic=recording.extrinsic,
        other_frames=recording.other_frames,
        in_world=recording.is_in_world,
        stamped=recording.is_stamped,
        time_unit=recording.time_unit,
        body="" if source is None else source.body,
        world="" if source is None else source.world,
        turn=None if axes is None else axes.rotation,
        twist=twist,
        offset=offset,
        mask=None if wanted.mask is None else np.array(wanted.mask, np.float32).reshape(2, 3),
        edges=edges,
        camera=recording.camera,
        used=tuple(used),
        assumptions=(),
        measured=measure(recording),
        findings=findings,
    )
    return replace(setup, assumptions=(*_assumptions(setup), *recording.problems))


def _assumptions(setup: Setup) -> list[str]:
    x, y, z = setup.extrinsic.position
    text = [f"clouds from {setup.points} in the frame {setup.cloud_frame!r}"]
    if setup.poses is None:
        return [*text, "no poses"]
    text[0] += ", which is that of the poses" if setup.in_world else ", which moves with the body"
    text.append(f"poses from {setup.poses}: {setup.body or 'the body'!r} in {setup.world or 'the world'!r}")
    text.append(f"times are {'the stamps' if setup.stamped else 'those of arrival'}")
    if not setup.in_world:
        w, qx, qy, qz = setup.extrinsic.quaternion
        turned = "not turned" if abs(w) > 1.0 - 1e-9 else f"turned by the quaternion {w:.3f} {qx:.3f} {qy:.3f} {qz:.3f}"
        text.append(f"the sensor is mounted at ({x:.2f}, {y:.2f}, {z:.2f}) m, {turned}; --extrinsic replaces this")
    text.append(
        "velocities are computed from the positions"
        if setup.twist == "none"
        else f"velocities are those of the messages, in the frame of the {setup.twist}"
    )
    return text
