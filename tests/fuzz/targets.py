"""What a user can do with a file of each kind, done to the end. Each target takes a path, and returns or raises."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import numpy as np

from aero_planner.config.file import load_config
from aero_planner.plan_inputs import check_inputs
from aero_viz.errors import UserError
from aero_viz.recordings import RecordingSource, inspect, open_recording
from aero_viz.scenes import World, load_map
from aero_viz.scenes.map_files import read_mesh, read_points

__all__ = ["TARGETS"]

_SWEEPS, _TICKS = 60, 20


def recording(path: Path) -> None:
    """Open and play a recording; every observation must be one that the planner takes."""
    with open_recording(path) as opened:
        assert np.isfinite(opened.sweep_times).all()
        for k in range(min(len(opened.sweep_times), _SWEEPS)):
            assert np.isfinite(opened.sweep(k).points).all()
        source = RecordingSource(opened)
        for _ in range(_TICKS):
            seen = source.observe()
            check_inputs(seen.state, seen.goal, seen.cloud_age, seen.ground_height, ())
            source.advance()


def report(path: Path) -> None:
    """Inspect a recording."""
    assert inspect(path).format_table()


def points(path: Path) -> None:
    """Read a map's triangles or points."""
    found = read_mesh(path)
    found = found if len(found) else read_points(path)
    assert np.isfinite(found).all()


def poses(path: Path) -> None:
    """Play a recording with the poses of a file."""
    with tempfile.TemporaryDirectory() as folder:
        clouds = Path(folder)
        for k in range(20):
            np.ones((5, 4), "<f4").tofile(clouds / f"{k}.bin")
        with open_recording(clouds, poses=path) as opened:
            assert opened.poses is not None
            for time in opened.sweep_times:
                pose = opened.poses.interpolate(float(time))
                assert np.isfinite(pose.position).all() and np.isfinite(pose.quaternion).all()


def world(path: Path) -> None:
    """Read a world and ask it for a distance."""
    opened = World.load(path)
    opened.distance([opened.start])


def config(path: Path) -> None:
    """Read a configuration."""
    try:
        load_config(path)
    except ValueError as error:  # the planner's package has no UserError
        raise UserError(str(error)) from error


def map_world(path: Path) -> None:
    """Make the world of a map, with start and goal."""
    opened = load_map(path)
    assert np.isfinite(list(islice(opened.start, 3))).all()


def unnamed(_: Path) -> None:
    """Refuse a file without its name."""
    raise UserError("the file is damaged")


def traceback(_: Path) -> None:
    """Fail as a reader must not."""
    raise ZeroDivisionError


def memory(_: Path) -> None:
    """Take more memory than allowed."""
    np.ones(3 << 27)


def slow(_: Path) -> None:
    """Take longer than allowed."""
    start = time.process_time()
    while time.process_time() < start + 5.5:
        pass


def crash(_: Path) -> None:
    """End the process."""
    os.abort()


TARGETS: dict[str, Callable[[Path], None]] = {
    "recording": recording,
    "report": report,
    "points": points,
    "map": map_world,
    "poses": poses,
    "world": world,
    "config": config,
    # Failures that the tests of the harness cause:
    "unnamed": unnamed,
    "traceback": traceback,
    "memory": memory,
    "slow": slow,
    "crash": crash,
}
