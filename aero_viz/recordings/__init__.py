"""Recordings of LiDAR sweeps and poses: MCAP, rosbag2 and ROS 1 bags behind one interface."""

from __future__ import annotations

from aero_viz.recordings.info import RecordingInfo, inspect
from aero_viz.recordings.poses import Pose, RecordedPoses
from aero_viz.recordings.recording import NO_POSES, PointSweep, Recording, open_recording
from aero_viz.recordings.source import RecordingSource

__all__ = [
    "NO_POSES",
    "PointSweep",
    "Pose",
    "RecordedPoses",
    "Recording",
    "RecordingInfo",
    "RecordingSource",
    "inspect",
    "open_recording",
]
