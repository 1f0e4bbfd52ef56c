"""Reading the sweeps of a folder for a report: their numbers of points, and the files that are damaged."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray

from aero_viz.recordings.bag_file import list_names
from aero_viz.recordings.cloud_files import CloudFiles
from aero_viz.recordings.recording import Recording
from aero_viz.recordings.storage import Storage

_TIME_MAX = 10.0
"""Longest time for the files of one folder [s]."""


def count_points(recording: Recording, storage: Storage) -> tuple[NDArray[np.int64], list[str]]:
    """Return the number of points in the playable sweeps, invalid ones included, and notices for the user.

    Messages of a bag say how many points they have. Files of clouds are read, evenly spread over the recording where
    reading all takes too long.
    """
    clouds = next((file for file in storage.files if isinstance(file, CloudFiles)), None)
    total = len(recording.sweep_times)
    if clouds is None or total < 2:
        return recording.sweep_counts, []
    end = time.monotonic() + _TIME_MAX
    counts: list[int] = []
    # Multiples of the golden ratio are spread evenly wherever they end.
    for index in np.argsort(np.arange(total) * 0.6180339887498949 % 1.0, kind="stable").tolist():
        if time.monotonic() > end:
            break
        sweep = recording.sweep(index)
        if index not in recording.damaged_sweeps:
            counts.append(len(sweep.points) + sweep.dropped)
    notices = []
    if len(counts) + len(recording.damaged_sweeps) < total:
        notices.append(f"the points of {len(counts)} of {total} sweeps are counted: reading all files takes too long")
    if damaged := sorted(clouds.damage.items()):
        names = list_names([f"{file.name} ({reason})" for file, reason in damaged])
        notices.append(f"{len(damaged)} of {total} files cannot be read and play without points: {names}")
    return np.array(counts or [0], np.int64), notices
