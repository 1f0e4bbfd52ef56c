"""The verbs on files of recordings: `aero-viz inspect` and `convert`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from aero_viz.cli.flags import FileName, OptionalText
from aero_viz.cli.output import print_report, progress_bar
from aero_viz.recordings.odometry import OdometryChoice

__all__ = ["convert", "inspect"]


def inspect(
    file: FileName,
    *,
    points_topic: OptionalText = None,
    pose_topic: OptionalText = None,
    json: bool = False,
) -> None:
    """Show what a recording contains and which parts can be played.

    Args:
        file: MCAP file, ROS 2 bag folder or .db3 file, or ROS 1 .bag file.
        points_topic: Topic of the point clouds; by default it is found by its type.
        pose_topic: Topic of the poses; by default it is found by its type.
        json: Print one JSON object.
    """
    from aero_viz.recordings import inspect as inspect_recording

    print_report(inspect_recording(file, points_topic=points_topic, pose_topic=pose_topic), as_json=json)


def convert(
    file: FileName,
    output: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="OUT.mcap")]],
    *,
    start: float = 0.0,
    end: float = float("inf"),
    topics: tuple[str, ...] = (),
    decimate: int = 1,
    odometry: OdometryChoice = "none",
    points_topic: OptionalText = None,
    pose_topic: OptionalText = None,
    json: bool = False,
) -> None:
    """Write a recording, or a part of it, as ROS 2 MCAP.

    Stamps, poses and all other messages stay as they are. Foxglove, RViz and rosbags open the file.

    Args:
        file: Recording of any format that `play` reads.
        output: MCAP file to write; an existing one is replaced.
        start: Leave out what precedes this time after the first message [s].
        end: Leave out what follows this time after the first message [s].
        topics: Write these topics only.
        decimate: Keep one of so many points of every cloud.
        odometry: Estimate the motion from the sweeps, as `play` does, and write it as /odometry and /tf.
        points_topic: Topic of the point clouds for the odometry; by default it is found by its type.
        pose_topic: Topic of the poses; by default it is found by its type.
        json: Print one JSON object.
    """
    from aero_viz.recordings import open_recording
    from aero_viz.recordings.convert import convert as convert_recording

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

        if odometry == "none":
            return write()
        with open_recording(
            file,
            points_topic=points_topic,
            pose_topic=pose_topic,
            odometry=odometry,
            progress=lambda done, total: show(done, total, f"estimating the motion: {done} of {total} sweeps"),
        ) as recording:
            write(recording=recording)
