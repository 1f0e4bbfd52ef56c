"""The commands on files of recordings: `aero-viz inspect` and `convert`."""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from aero_planner.output_files import check_output_files
from aero_viz.cli.flags import FileName, Inline, RecordingFlags
from aero_viz.cli.output import print_report, progress_bar
from aero_viz.errors import UserError

if TYPE_CHECKING:
    from aero_viz.recordings import Recording

_RECORDING = RecordingFlags()


def inspect(
    file: FileName,
    *,
    check_poses: bool = False,
    recording_flags: Inline[RecordingFlags] = _RECORDING,
    json: bool = False,
) -> None:
    """Show what a recording contains and which parts can be played.

    Args:
        file: ROS bag, MCAP file, folder or file of clouds, or capture of packets; or a log of PX4 (ULog), whose
            parameters and hover thrust are checked.
        check_poses: Register all sweeps, each with those before or, with --map, with that map, and report by how much
            the poses drift and turn against it.
        recording_flags: The recording.
        json: Print one JSON object.
    """
    from aero_viz.recordings import inspect as inspect_recording
    from aero_viz.recordings.px4_check import check_px4_log, is_px4_log

    if is_px4_log(Path(file)):
        print_report(check_px4_log(Path(file)), as_json=json)
        return
    with progress_bar(file, enabled=not json) as update_bar:
        options = recording_flags.options()
        options["progress"] = lambda done, total: update_bar(done, total, f"{done} of {total} registrations")
        report = inspect_recording(file, check_poses=check_poses, **options)
    print_report(report, as_json=json)
    if not report.sweeps:
        raise SystemExit(2)


def convert(
    file: FileName,
    output: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="OUT.mcap")]],
    *,
    start: float = 0.0,
    end: float = float("inf"),
    topics: tuple[str, ...] = (),
    decimate: int = 1,
    to: Literal["mcap", "rrd"] = "mcap",
    overwrite: bool = False,
    recording_flags: Inline[RecordingFlags] = _RECORDING,
    json: bool = False,
) -> None:
    """Write a recording, or a part of it, as ROS 2 MCAP.

    Stamps, poses and all other messages stay as they are. Foxglove, RViz and rosbags open the file.

    Args:
        file: Recording of any format that `play` reads.
        output: MCAP file to write.
        start: Leave out messages before this time, counted from the first message [s].
        end: Leave out messages after this time, counted from the first message [s].
        topics: Write these topics and /tf_static only.
        decimate: Keep every n-th point of each cloud.
        to: Format to write. Rerun opens MCAP itself; rrd prints how to convert it.
        overwrite: Replace an existing file.
        recording_flags: The recording. Poses that are estimated or read from a file are written as /odometry and /tf,
            in place of the recorded ones.
        json: Print one JSON object.
    """
    from aero_viz.recordings import open_recording
    from aero_viz.recordings.choices import Choices
    from aero_viz.recordings.convert import convert as convert_recording
    from aero_viz.recordings.convert import refuse_source
    from aero_viz.recordings.storage import open_storage

    if to == "rrd" or output.suffix.lower() == ".rrd":
        mcap, rrd = output.with_suffix(".mcap"), output.with_suffix(".rrd")
        raise UserError(
            f"AERO-Viz does not write Rerun's format. Write MCAP with `aero-viz convert {file} {mcap}`; Rerun shows it "
            f"with `rerun {mcap}`, and converts it with `rerun mcap convert {mcap} -o {rrd}`."
        )
    if output.suffix.lower() != ".mcap":
        raise UserError(f"{output} would hold MCAP; give a name that ends in .mcap, such as {output.stem}.mcap.")
    if output.exists():
        with contextlib.closing(open_storage(file)) as storage:
            refuse_source(output, storage)
    check_output_files(output, overwrite=overwrite)
    window = {"start": start, "end": end, "topics": topics, "decimate": decimate}
    with progress_bar(file, enabled=not json) as update_bar:

        def show(done: float, total: float, text: str) -> None:
            update_bar(done, max(total, 1e-9), text)

        def write(**options: object) -> None:
            report = convert_recording(
                file,
                output,
                **window,  # type: ignore[arg-type]
                **options,  # type: ignore[arg-type]
                progress=lambda done, total: show(done, total, f"{done:.0f} of {total:.0f} s"),
            )
            print_report(report, as_json=json)

        choices = Choices(recording_flags.columns, recording_flags.sensor)
        if dataclasses.replace(recording_flags, columns=None, sensor=None) == _RECORDING:
            return write(choices=choices)
        if recording_flags.pose_topic is not None:
            raise UserError(
                "--pose-topic has no effect: all topics of poses are written; name those to write with --topics."
            )
        if recording_flags.poses is not None and recording_flags.odometry != "none":
            raise UserError("--odometry has no effect with --poses, which gives the poses to write: leave one out.")
        options = recording_flags.options()
        options["progress"] = lambda done, total: show(done, total, f"estimating the motion: {done} of {total} sweeps")
        with open_recording(file, **options) as recording:
            _refuse_unused(recording_flags, recording, output)
            write(recording=recording, choices=choices)


def _refuse_unused(flags: RecordingFlags, recording: Recording, output: Path) -> None:
    """Raise UserError for a flag that would change nothing in the converted file."""
    from aero_viz.recordings.convert import has_new_poses

    if flags.mask is not None and recording.pose_origin != "odometry":
        raise UserError(
            "--mask has no effect: clouds are written whole, and only --odometry needs it to estimate the motion. "
            f"Leave it out, and play {output} with it."
        )
    if has_new_poses(recording):
        return
    if flags.extrinsic is not None:
        raise UserError(
            "--extrinsic has no effect: the mounting is written only with the poses of --poses or --odometry. Leave it "
            f"out, and play {output} with it."
        )
    if flags.points_topic is not None:
        raise UserError(
            "--points-topic has no effect: all topics of clouds are written; name those to write with --topics."
        )
