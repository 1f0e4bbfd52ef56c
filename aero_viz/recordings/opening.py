"""Opening a recording with the options that the user gives: topics, poses, odometry, mounting and mask."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from aero_planner.quaternions import compose_transforms, quaternion_from_angles
from aero_viz.errors import UserError
from aero_viz.recordings.choices import Choices, CloudFrame
from aero_viz.recordings.contents import Contents, read_contents
from aero_viz.recordings.recording import Recording
from aero_viz.recordings.storage import Storage, open_storage, readable
from aero_viz.recordings.transforms import IDENTITY, Transform

if TYPE_CHECKING:
    from aero_viz.recordings.odometry import OdometryProgress
    from aero_viz.recordings.odometry_choice import OdometryChoice


def open_recording(
    path: str | Path,
    *,
    points_topic: str | None = None,
    pose_topic: str | None = None,
    odometry: OdometryChoice = "none",
    poses: str | Path | None = None,
    extrinsic: Sequence[float] | None = None,
    mask: Sequence[float] | None = None,
    columns: str | None = None,
    sensor: str | None = None,
    cloud_frame: CloudFrame = "auto",
    progress: OdometryProgress = lambda done, total: None,
) -> Recording:
    """Open a recording of any supported format: a bag, files or folders of clouds, or a capture of packets.

    One pass over the file reads the poses and finds the sweeps; a sweep is read when it is asked for.

    Args:
        path: file or folder.
        points_topic: topic of the sweeps; None chooses the one with the most clouds.
        pose_topic: topic of the poses; None chooses the first one of Odometry, PoseStamped,
            PoseWithCovarianceStamped, TransformStamped and TF that overlaps the sweeps, and of these first those whose
            frame is joined to that of the clouds.
        odometry: "auto" estimates poses from the sweeps where none are recorded, "rko-lio" and "kiss-icp" also
            replace recorded ones, "none" estimates nothing. The estimate is kept in the user's cache folder.
        poses: file of poses to play with, see `aero_viz.recordings.pose_files`; None plays with the recorded ones.
        extrinsic: x, y, z [m] and roll, pitch, yaw [deg] of the sensor in the body's frame, in place of the recorded
            pose.
        mask: box in the body's frame whose points are left out, see `Recording.mask`.
        columns, sensor, cloud_frame: see `aero_viz.recordings.choices.Choices`.
        progress: called while poses are estimated.

    Raises:
        UserError: the recording cannot be played, or its motion cannot be estimated.
    """
    storage = open_storage(path, Choices(columns, sensor, cloud_frame))
    try:
        with readable(storage.path):
            contents = read_contents(storage)
            recording = Recording(storage, contents, points_topic, pose_topic)
            configure_recording(
                recording,
                storage,
                contents,
                odometry=odometry,
                poses=poses,
                extrinsic=extrinsic,
                mask=mask,
                progress=progress,
            )
            return recording
    except BaseException:
        storage.close()
        raise


def configure_recording(
    recording: Recording,
    storage: Storage,
    contents: Contents,
    *,
    odometry: OdometryChoice = "none",
    poses: str | Path | None = None,
    extrinsic: Sequence[float] | None = None,
    mask: Sequence[float] | None = None,
    progress: OdometryProgress = lambda done, total: None,
) -> None:
    """Apply the options of `open_recording` to a recording, and use the poses of a file next to its clouds."""
    if extrinsic is not None:
        recording.mount(_mounting(extrinsic))
    if mask is not None:
        lower, upper = np.reshape(_checked(mask, "--mask", "the corners of a box [m]"), (2, 3)).tolist()
        if not all(low < high for low, high in zip(lower, upper, strict=True)):
            raise UserError(f"--mask takes the lower corner of a box before the upper one, not {lower} before {upper}.")
        recording.mask(mask)
    if poses is None and odometry in ("none", "auto") and recording.poses is None:
        poses = storage.pose_file
    if poses is not None:
        from aero_viz.recordings.pose_files import add_poses

        add_poses(recording, Path(poses))
    elif odometry != "none" and (recording.poses is None or odometry != "auto"):
        _add_odometry(recording, storage, contents, odometry, progress)
    if len(recording.sweep_times) == 1 and storage.format.startswith(("mcap", "rosbag")):
        recording.problems.append(
            f"a single cloud is one sweep; to fly through it as a world: aero-viz demo {recording.path.name}"
        )
    if recording.is_in_world and recording.poses is not None:
        from aero_viz.recordings.cloud_frame import turns_with_body

        if found := turns_with_body(recording, recording.poses):
            recording.frame_fault = found
            recording.problems.append(f"{found.evidence}: {found.advice}")


def _mounting(values: Sequence[float]) -> Transform:
    x, y, z, roll, pitch, yaw = _checked(values, "--extrinsic", "x y z [m] roll pitch yaw [deg]")
    return Transform(np.array([x, y, z]), quaternion_from_angles(roll, pitch, yaw))


def _checked(values: Sequence[float], flag: str, meaning: str) -> Sequence[float]:
    if len(values) != 6 or not np.isfinite(values).all():
        raise UserError(f"{flag} takes six finite numbers, {meaning}, not {list(values)}.")
    return values


def _add_odometry(
    recording: Recording, storage: Storage, contents: Contents, choice: OdometryChoice, progress: OdometryProgress
) -> None:
    """Estimate the motion of a recording, unless it is in the cache, and use it."""
    from aero_viz.recordings.imu import read_imu
    from aero_viz.recordings.odometry import choose_method, estimate_motion
    from aero_viz.recordings.odometry_cache import load_motion, motion_key, save_motion

    imu = read_imu(storage.files)
    method = choose_method(choice, imu, timed=any(recording.sweep(i).point_times is not None for i in (0, -1)))
    files = [part for file in storage.files for part in file.parts]
    key = motion_key(files, method, recording.points_topic, recording.pose_topic, *recording.changes)
    motion = load_motion(key)
    if motion is None:
        mount = contents.transforms.between(recording.cloud_frame, imu.frame) if imu else None
        if mount is not None:
            mount = Transform(*compose_transforms(*recording.extrinsic, *mount))
        motion = estimate_motion(
            recording, method, imu, imu_mount=mount or IDENTITY, start=recording.start, progress=progress
        )
        if imu and mount is None:
            notice = (
                f"no static transform joins the IMU's frame {imu.frame!r} and that of the body: assumed to be the same"
            )
            motion = motion._replace(problems=(*motion.problems, notice))
        save_motion(key, motion)
    source = f"poses are estimated by {motion.method}, {motion.ms_per_sweep:.0f} ms a sweep"
    recording.use_poses(motion.poses(), f"odometry by {motion.method}", [source, *motion.problems], origin="odometry")
