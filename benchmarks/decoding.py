"""Measure how many points a second of processor time decodes, by format, beside the library that defines the format.

AERO-Viz opens the recording, checks it, and returns valid points with their times; a library returns its plain arrays.
The file has 20 sweeps of 65 536 points. Processes that are started count, too.
"""

from __future__ import annotations

import json
import resource
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import open3d
from rosbags.highlevel import AnyReader

from aero_viz.recordings import open_recording
from benchmarks import large_recording
from benchmarks.common import machine

SWEEPS = 20
POINTS = SWEEPS * large_recording.SWEEP_POINTS


def points_per_second(function: Callable[..., object], *arguments: Any) -> float:
    """Return the million points that a call decodes per second of processor time."""
    before = cpu_time()
    function(*arguments)
    return round(1e-6 * POINTS / (cpu_time() - before), 1)


def cpu_time() -> float:
    """Return the processor time of this process and of those that it has waited for [s]; `os.times` counts in 10 ms."""
    usages = map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def decode(path: Path) -> None:
    """Decode all sweeps of a recording."""
    with open_recording(path) as recording:
        for index in range(len(recording.sweep_times)):
            recording.sweep(index)


def read_bag(path: Path) -> None:
    """Read the clouds of a bag as rosbags does."""
    with AnyReader([path]) as reader:
        for connection, _, data in reader.messages([c for c in reader.connections if "PointCloud2" in c.msgtype]):
            reader.deserialize(data, connection.msgtype)


def write_las(path: Path, points: np.ndarray) -> None:
    las = laspy.LasData(laspy.LasHeader(point_format=3, version="1.2"))
    las.x, las.y, las.z = points.T
    las.write(str(path))


def write_open3d(path: Path, points: np.ndarray) -> None:
    open3d.io.write_point_cloud(path, open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points)))


def read_las(path: Path) -> object:
    return laspy.read(str(path)).xyz


FILES: dict[str, tuple[Callable[[Path, np.ndarray], object], Callable[[Path], object]]] = {
    "pcd": (write_open3d, open3d.io.read_point_cloud),
    "ply": (write_open3d, open3d.io.read_point_cloud),
    "las": (write_las, read_las),
    "laz": (write_las, read_las),
    "npy": (np.save, np.load),
    "bin": (lambda path, points: np.column_stack([points, points[:, 0]]).tofile(path), np.fromfile),
}


def main() -> None:
    """Print the figures as JSON."""
    figures = {}
    with tempfile.TemporaryDirectory() as folder:
        for kind in ("mcap", "sqlite3"):
            path = large_recording.write(Path(folder), 16 * POINTS, kind=kind)
            decode(path)  # imports
            figures[kind] = points_per_second(decode, path), points_per_second(read_bag, path)
        points = np.random.default_rng(0).uniform(-20.0, 20.0, (large_recording.SWEEP_POINTS, 3)).astype(np.float32)
        for suffix, (write, read) in FILES.items():
            path = Path(folder) / suffix
            path.mkdir()
            for index in range(SWEEPS):
                write(path / f"{index}.{suffix}", points)
            plain = points_per_second(lambda path=path, read=read: [read(file) for file in path.iterdir()])
            figures[suffix] = points_per_second(decode, path), plain
    print(json.dumps({"machine": machine("cpu"), "unit": "M points/s: AERO-Viz, library", "formats": figures}))


if __name__ == "__main__":
    main()
