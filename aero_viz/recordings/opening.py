"""Opening a recording with the options that the user gives: topics, poses, odometry, mounting and mask."""

from __future__ import annotations

import hashlib
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
    from aero_viz.recordings.odometry import Motion, OdometryProgress
    from aero_viz.recordings.odometry_choice import OdometryChoice


def open_recording(
    path: str | Path,
    *,
    points_topic: str | None = None,
    pose_topic: str | None = None,
    odometry: OdometryChoice = "none",
    poses: str | Path | None = None,
    map: str | Path | None = None,
    map_start: Sequence[float] | None = None,
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
        map: cloud in which the sweeps are located, see `aero_viz.recordings.localization`; other poses are then the
            first guess of the motion. The result is kept in the cache folder, too.
        map_start: x, y, z [m] and roll, pitch, yaw [deg] of the body in the map at the first sweep; None is the first
            of the other poses, or the origin.
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
                map=map,
                map_start=map_start,
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
    map: str | Path | None = None,
    map_start: Sequence[float] | None = None,
    extrinsic: Sequence[float] | None = None,
    mask: Sequence[float] | None = None,
    progress: OdometryProgress = lambda done, total: None,
) -> None:
    """Apply the options of `open_recording` to a recording, and use the poses of a file next to its clouds."""
    if extrinsic is not None:
        recording.mount(pose_of(extrinsic, "--extrinsic"))
    if mask is not None:
        check_mask(mask)
        recording.mask(mask)
    if poses is None and odometry in ("none", "auto") and recording.poses is None:
        poses = storage.pose_file
    if poses is not None:
        from aero_viz.recordings.pose_files import add_poses

        add_poses(recording, Path(poses))
    elif odometry != "none" and (recording.poses is None or odometry != "auto"):
        _add_odometry(recording, storage, contents, odometry, progress)
    if map is not None:
        motion = motion_in_map(recording, storage, Path(map), map_start, progress)
        _use_motion(recording, motion, f"poses in {Path(map).name}")
    elif map_start is not None:
        raise UserError("--map-start is a pose in the map of --map: give that, too.")
    if len(recording.sweep_times) == 1 and storage.format.startswith(("mcap", "rosbag")):
        recording.problems.append(
            f"a single cloud is one sweep; to fly through it as a world: aero-viz demo {recording.path.name}"
        )
    if recording.is_in_world and recording.poses is not None:
        from aero_viz.recordings.cloud_frame import turns_with_body

        if found := turns_with_body(recording, recording.poses):
            recording.frame_fault = found
            recording.problems.append(f"{found.evidence}: {found.advice}")


def check_mask(mask: Sequence[float]) -> None:
    """Raise UserError if --mask is not the lower corner of a box and then the upper one [m], [6]."""
    lower, upper = np.reshape(_checked(mask, "--mask", "the corners of a box [m]"), (2, 3)).tolist()
    if not all(low < high for low, high in zip(lower, upper, strict=True)):
        raise UserError(f"--mask takes the lower corner of a box before the upper one, not {lower} before {upper}.")


def pose_of(values: Sequence[float], flag: str) -> Transform:
    """Return the pose that a flag gives as x, y, z [m], roll, pitch, yaw [deg]; UserError if these are no pose."""
    x, y, z, roll, pitch, yaw = _checked(values, flag, "x y z [m] roll pitch yaw [deg]")
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
    _use_motion(recording, motion, f"odometry by {motion.method}")


def motion_in_map(
    recording: Recording, storage: Storage, path: Path, start: Sequence[float] | None, progress: OdometryProgress
) -> Motion:
    """Return the motion of a recording in a map, from the cache where it is known; see `open_recording`."""
    from aero_viz.recordings.localization import locate_in_map, read_map_points
    from aero_viz.recordings.odometry_cache import load_motion, motion_key, save_motion

    first, known = IDENTITY, recording.poses
    if start is not None:
        first = pose_of(start, "--map-start")
    elif known is not None:
        pose = known.interpolate(recording.sweep_times[0])
        first = Transform(pose.position + known.offset, pose.quaternion)
    cloud = read_map_points(path)
    files = [part for file in storage.files for part in file.parts]
    settings = [cloud, *first, *(() if known is None else (known.times, known.positions, known.quaternions))]
    digest = hashlib.blake2b(b"".join(np.ascontiguousarray(values).tobytes() for values in settings)).hexdigest()
    key = motion_key(files, digest, recording.points_topic, *recording.changes)
    motion = load_motion(key)
    if motion is None:
        motion = locate_in_map(recording, cloud, first, progress=progress)
        save_motion(key, motion)
    return motion


def _use_motion(recording: Recording, motion: Motion, name: str) -> None:
    """Play with an estimated motion, and the sweeps that have a pose in it."""
    poses, sweeps = motion.poses(), recording.sweep_times
    covered = poses.covers(sweeps)
    recording.keep(covered)
    source = f"poses are estimated by {motion.method}, {motion.ms_per_sweep:.0f} ms a sweep"
    source += "" if np.isnan(motion.fitness) else f", fit {motion.fitness:.0%}"
    first = float(sweeps[covered][0])
    recording.use_poses(poses.shifted(first), name, [source, *motion.problems], origin="odometry")
