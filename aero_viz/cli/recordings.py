"""The verb that reports on recordings: `aero-viz inspect`."""

from __future__ import annotations

import json as json_module

from aero_viz.cli.flags import FileName, OptionalText

__all__ = ["inspect"]


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

    info = inspect_recording(file, points_topic=points_topic, pose_topic=pose_topic)
    print(json_module.dumps(info.to_dict(), allow_nan=False) if json else info.format_table())
