"""Write a large ROS 2 bag, and measure how fast it opens, how fast any time is reached, and what memory that takes.

The bag has sweeps of 65 536 points with times at 10 Hz, 1 MiB each, and odometry at 50 Hz. It is deleted at the end.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from aero_planner import VehicleState
from aero_planner.cli_util import run_command
from aero_planner.onboard.ros_definitions import DEFINITIONS
from aero_planner.onboard.ros_messages import Encoded, pose_messages, sweep
from benchmarks.common import machine, run_program

SWEEP_POINTS = 65_536
START = 1_700_000_000_000_000_000
_PERIOD, _POSES = 100_000_000, 5
_SEEKS, _PLAYED = 30, 100
_PROGRAM = """
import json, sys, time
from pathlib import Path
import numpy as np
from aero_viz.recordings import RecordingSource, open_recording
def peak():  # [MB]; getrusage would count the process that started this one
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024
before = peak()
began, cpu = time.perf_counter(), time.process_time()
recording = open_recording(sys.argv[1])
report = {"open_s": time.perf_counter() - began, "open_cpu_s": time.process_time() - cpu}
report["sweeps"] = len(recording.sweep_times)
source, seeks, cpus = RecordingSource(recording, sweeps=1), [], []
for time_s in np.random.default_rng(1).uniform(0.0, recording.sweep_times[-1], int(sys.argv[2])):
    began, cpu = time.perf_counter(), time.process_time()
    source.seek(float(time_s))
    observation = source.observe()
    seeks.append(1e3 * (time.perf_counter() - began))
    cpus.append(1e3 * (time.process_time() - cpu))
    index = int(np.searchsorted(recording.sweep_times, observation.time, side="right")) - 1
    assert round(float(recording.sweep(index).points[0, 0])) == index % 1000, "another sweep was read"
report |= {"seek_ms_median": float(np.median(seeks)), "seek_ms_max": max(seeks), "seek_cpu_ms_max": max(cpus)}
began, cpu = time.perf_counter(), time.process_time()
count = min(int(sys.argv[3]), report["sweeps"])
for index in range(count):
    recording.sweep(index)
report["play_ms_per_sweep"] = 1e3 * (time.perf_counter() - began) / count
report["play_cpu_ms_per_sweep"] = 1e3 * (time.process_time() - cpu) / count
report["memory_mb"] = peak() - before
print(json.dumps(report))
"""


def write(folder: Path, size: int, *, kind: str) -> Path:
    """Write a bag of about `size` bytes, and return its path. The x of the first point is the sweep's number mod 1000.

    Args:
        folder: existing folder.
        size: [bytes].
        kind: "mcap" or "sqlite3".
    """
    random = np.random.default_rng(0)
    points = random.uniform(-20.0, 20.0, (SWEEP_POINTS, 3)).astype(np.float32)
    times = np.sort(random.integers(0, _PERIOD, SWEEP_POINTS)).astype(np.uint32)
    path = folder / ("large.mcap" if kind == "mcap" else "large")
    with _BagWriter(path, kind) as add:
        for index in range(max(size // (16 * SWEEP_POINTS), 2)):
            stamp = START + _PERIOD * index
            for i in range(_POSES):
                at = stamp + i * _PERIOD // _POSES
                state = VehicleState([1e-9 * (at - START), 0.0, 2.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0])
                add(next(iter(pose_messages(state, at))), at)
            points[0] = index % 1000, 1.0, 0.0  # all zeros would mean that nothing was hit
            add(sweep(points, stamp, times=times), stamp)
    return path


class _BagWriter:
    """Opens a bag for writing; its value adds a message with a stamp [ns]."""

    def __init__(self, path: Path, kind: str) -> None:
        self._path, self._kind = path, kind
        self._channels: dict[str, Any] = {}

    def __enter__(self) -> Any:
        if self._kind == "mcap":
            self._mcap = McapWriter(str(self._path), compression=CompressionType.NONE, enable_crcs=False)
            self._mcap.start(profile="ros2", library="aero-viz")
            return self._add_mcap
        self._bag = Writer2(self._path, version=9, storage_plugin=StoragePlugin.SQLITE3)
        self._bag.open()
        return self._add_sqlite

    def __exit__(self, *_: object) -> None:
        self._mcap.finish() if self._kind == "mcap" else self._bag.close()

    def _add_mcap(self, message: Encoded, stamp: int) -> None:
        if message.topic not in self._channels:
            schema = self._mcap.register_schema(message.kind, "ros2msg", DEFINITIONS[message.kind].encode())
            self._channels[message.topic] = self._mcap.register_channel(message.topic, "cdr", schema)
        self._mcap.add_message(self._channels[message.topic], stamp, message.data, stamp)

    def _add_sqlite(self, message: Encoded, stamp: int) -> None:
        if message.topic not in self._channels:
            store = get_typestore(Stores.ROS2_HUMBLE)
            self._channels[message.topic] = self._bag.add_connection(message.topic, message.kind, typestore=store)
        self._bag.write(self._channels[message.topic], stamp, message.data)


def measure(path: Path) -> dict[str, Any]:
    """Open, seek and play in a new process, with the file out of the system's cache, and return the figures.

    Raises:
        ValueError: the process failed; the message is its last line.
    """
    for file in [path] if path.is_file() else path.iterdir():
        with file.open("rb") as opened:
            os.fsync(opened.fileno())
            if hasattr(os, "posix_fadvise"):
                os.posix_fadvise(opened.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
    return run_program(_PROGRAM, path, _SEEKS, _PLAYED, failure="the recording did not play")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0.

    Raises:
        ValueError: the folder is too small.
    """
    parser = argparse.ArgumentParser(prog="python -m benchmarks.large_recording", description=__doc__)
    parser.add_argument("--gigabytes", type=float, default=8.0, help="size of the bag")
    parser.add_argument("--kind", choices=["mcap", "sqlite3"], default="mcap")
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()), help="where to write it")
    options = parser.parse_args(arguments)
    size = round(1e9 * options.gigabytes)
    if shutil.disk_usage(options.folder).free < 1.2 * size:
        raise ValueError(f"{options.folder} has less than {1.2 * options.gigabytes:.1f} GB free: give another --folder")
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        path = write(Path(folder), size, kind=options.kind)
        print(json.dumps({"machine": machine("cpu"), "kind": options.kind, "bytes": size, **measure(path)}, indent=2))
    return 0


if __name__ == "__main__":
    run_command(main)
