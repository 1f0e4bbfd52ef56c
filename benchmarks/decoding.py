"""Measure how many points a second of processor time decodes, by format, beside the library that defines the format.

AERO-Viz opens the recording, checks it, and returns valid points with their times; a library returns its plain arrays.
The file has 20 sweeps of 65 536 points. Processes that are started count, too.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from aero_planner.cli_util import run_command
from aero_viz.recordings import RecordingSource, open_recording
from benchmarks import large_recording
from benchmarks.common import machine

SWEEPS = 20
POINTS = SWEEPS * large_recording.SWEEP_POINTS


def cpu_seconds(function: Callable[[], object]) -> float:
    """Return the processor time of a call [s]."""
    before = sum(os.times()[:4])
    function()
    return max(sum(os.times()[:4]) - before, 1e-3)


def decode(path: Path, *, placed: bool = False) -> None:
    """Decode all sweeps of a recording, and move each point to the world if it is to be placed."""
    with open_recording(path) as recording:
        source = RecordingSource(recording, sweeps=1)
        for index, time in enumerate(recording.sweep_times):
            if placed:
                source.seek(float(time))
                source.observe()
            else:
                recording.sweep(index)


def read_bag(path: Path) -> None:
    """Read the clouds of a bag as rosbags does, with one view of each."""
    from rosbags.highlevel import AnyReader

    with AnyReader([path]) as reader:
        for connection, _, data in reader.messages([c for c in reader.connections if "PointCloud2" in c.msgtype]):
            cloud = reader.deserialize(data, connection.msgtype)
            np.ndarray(cloud.width, "<f4", cloud.data, strides=(cloud.point_step,)).sum()  # type: ignore[attr-defined]


def write_clouds(folder: Path) -> dict[str, Callable[[Path], object]]:
    """Write folders of clouds of every format; return the function of each format's library."""
    import laspy
    import open3d

    points = np.random.default_rng(0).uniform(-20.0, 20.0, (large_recording.SWEEP_POINTS, 3)).astype(np.float32)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    las = laspy.LasData(laspy.LasHeader(point_format=3, version="1.2"))
    las.x, las.y, las.z = points.T
    for suffix in ("pcd", "ply", "las", "laz", "npy", "bin"):
        (folder / suffix).mkdir()
        for index in range(SWEEPS):
            path = folder / suffix / f"{index}.{suffix}"
            if suffix in ("pcd", "ply"):
                open3d.io.write_point_cloud(path, cloud)
            elif suffix in ("las", "laz"):
                las.write(str(path))
            elif suffix == "npy":
                np.save(path, points)
            else:
                np.column_stack([points, points[:, 0]]).tofile(path)
    read_las = lambda path: laspy.read(str(path)).xyz  # noqa: E731
    read_cloud = open3d.io.read_point_cloud
    read_bin = lambda path: np.fromfile(path, np.float32).reshape(-1, 4)  # noqa: E731
    return {"pcd": read_cloud, "ply": read_cloud, "las": read_las, "laz": read_las, "npy": np.load, "bin": read_bin}


def main() -> int:
    """Print the figures as JSON; return 0."""
    with tempfile.TemporaryDirectory() as name:
        folder, rows = Path(name), {}
        for kind in ("mcap", "sqlite3"):
            path = large_recording.write(folder, 16 * POINTS, kind=kind)
            placed = cpu_seconds(lambda path=path: decode(path, placed=True))
            rows[kind] = (cpu_seconds(lambda path=path: decode(path)), cpu_seconds(lambda path=path: read_bag(path)))
            rows[f"{kind}, moved to the world"] = (placed, rows[kind][1])
        for suffix, read in write_clouds(folder).items():
            path = folder / suffix
            plain = cpu_seconds(lambda path=path, read=read: [read(file) for file in path.iterdir()])
            rows[suffix] = (cpu_seconds(lambda path=path: decode(path)), plain)
        figures = {
            name: {"M points/s": round(1e-6 * POINTS / ours, 1), "library": round(1e-6 * POINTS / plain, 1)}
            for name, (ours, plain) in rows.items()
        }
        print(json.dumps({"machine": machine("cpu"), "formats": figures}, indent=2))
    return 0


if __name__ == "__main__":
    run_command(lambda arguments=None: main())
