"""Recordings of LiDAR sweeps and poses: MCAP, rosbag2 and ROS 1 bags behind one interface."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aero_planner.lazy_import import lazy_exports

if TYPE_CHECKING:
    from aero_viz.recordings.cloud_files import PacketClouds, StampedCloud
    from aero_viz.recordings.info import RecordingInfo, inspect
    from aero_viz.recordings.opening import open_recording
    from aero_viz.recordings.poses import Pose, RecordedPoses
    from aero_viz.recordings.recording import NO_POSES, PointSweep, Recording
    from aero_viz.recordings.source import RecordingSource
    from aero_viz.recordings.storage import FORMATS

__all__ = [
    "FORMATS",
    "NO_POSES",
    "PacketClouds",
    "PointSweep",
    "Pose",
    "RecordedPoses",
    "Recording",
    "RecordingInfo",
    "RecordingSource",
    "StampedCloud",
    "inspect",
    "open_recording",
]

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "cloud_files": ("PacketClouds", "StampedCloud"),
        "info": ("RecordingInfo", "inspect"),
        "opening": ("open_recording",),
        "poses": ("Pose", "RecordedPoses"),
        "recording": ("NO_POSES", "PointSweep", "Recording"),
        "source": ("RecordingSource",),
        "storage": ("FORMATS",),
    },
)
