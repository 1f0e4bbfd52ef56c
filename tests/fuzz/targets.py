"""Actions of a user on a file of each kind, done to the end.

Each target takes a path, and raises, or returns what was read and what was said about it.
"""

import hashlib
import json
import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from fuzz import telemetry
from fuzz.ports import PORTS

from aero_planner.onboard.flight_config import load_any
from aero_planner.plan_inputs import check_inputs
from aero_viz.catalog import open_source
from aero_viz.errors import UserError
from aero_viz.logs.comparison import compare_logs
from aero_viz.logs.replay import FlightReplay
from aero_viz.recordings import Recording, RecordingSource, inspect, open_recording
from aero_viz.scenes import World
from aero_viz.scenes.decoding_process import DecodingProcess
from aero_viz.scenes.map_files import read_map, read_solids

_SWEEPS, _TICKS = 60, 20


@dataclass(frozen=True)
class Reading:
    """Data that were read, to be compared with those of a whole file."""

    digest: str = ""
    """Checksum of all that is played; two different ones are two different contents."""
    remarks: str = ""
    """Messages to the user."""


@cache
def _decoding_process() -> DecodingProcess:
    return DecodingProcess()


def recording(path: Path) -> Reading:
    """Open and play a recording; every observation must be one that the planner takes."""
    with open_recording(path) as opened:
        return _play(opened, RecordingSource(opened))


def flight_log(path: Path) -> Reading:
    """Replay a flight log, and compare it with itself."""
    source = open_source(str(path))
    assert isinstance(source, RecordingSource)
    with source.recording as opened:
        reading = _play(opened, source)
    if isinstance(source, FlightReplay):
        assert compare_logs(path, path).format_table()
    return reading


def _play(opened: Recording, source: RecordingSource) -> Reading:
    parts: list[Any] = [opened.sweep_times]
    assert np.isfinite(opened.sweep_times).all()
    for k in range(min(len(opened.sweep_times), _SWEEPS)):
        sweep = opened.sweep(k)
        assert np.isfinite(sweep.points).all()
        parts += [sweep.points, sweep.point_times, sweep.dropped]
    if opened.poses is not None:
        parts += [opened.poses.times, opened.poses.positions, opened.poses.quaternions]
    for _ in range(_TICKS):
        seen = source.observe()
        check_inputs(seen.state, seen.goal, seen.cloud_age, seen.ground_height, ())
        parts += [seen.goal.position, seen.state.velocity]
        source.advance()
    return Reading(_digest(*parts), "; ".join([*opened.problems, opened.damage or ""]))


def report(path: Path) -> Reading:
    """Inspect a recording."""
    return Reading(inspect(path).format_table())


def points(path: Path) -> Reading:
    """Read a map's triangles or points, in one process for all files as for a folder of clouds."""
    found = read_map(path, _decoding_process())
    assert np.isfinite(found).all()
    return Reading(_digest(found))


def solids(path: Path) -> Reading:
    """Read a Gazebo world or an occupancy image."""
    return Reading(_digest(repr(read_solids(path / "a.yaml" if path.is_dir() else path))))


def poses(path: Path) -> Reading:
    """Play a recording with the poses of a file."""
    with tempfile.TemporaryDirectory() as folder:
        clouds = Path(folder)
        for k in range(20):
            np.ones((5, 4), "<f4").tofile(clouds / f"{k}.bin")
        with open_recording(clouds, poses=path) as opened:
            assert opened.poses is not None
            found = [opened.poses.interpolate(float(time)) for time in opened.sweep_times]
            assert all(np.isfinite(p.position).all() and np.isfinite(p.quaternion).all() for p in found)
            parts = [opened.poses.times, opened.poses.positions, opened.poses.quaternions]
            return Reading(_digest(*parts), "; ".join(opened.problems))


def world(path: Path) -> Reading:
    """Read a world and ask it for a distance."""
    opened = World.load(path)
    opened.distance([opened.start])
    return Reading(_digest(json.dumps(opened.to_dict())))


def config(path: Path) -> Reading:
    """Read a configuration of planner and node."""
    try:
        return Reading(_digest(repr(load_any(path))))
    except ValueError as error:  # the planner's package has no UserError
        raise UserError(str(error)) from error


def port(path: Path) -> Reading:
    """Feed datagrams, a stream of bytes or a bundle to the parsers of the node."""
    try:
        return Reading(remarks=f"{PORTS[path.name].feed(path)} accepted")
    except ValueError as error:
        if not str(error).endswith(".") or "\n" in str(error):
            raise
        raise UserError(f"{path.name}: {error}") from error


def node(path: Path) -> None:
    """Connect to a node that sends the content of a file."""
    try:
        telemetry.read(path)
    except UserError as error:
        raise UserError(f"{path.name}: {error}") from error


def page(path: Path) -> None:
    """Send messages to a page."""
    from fuzz.page import send_messages  # viser and the planner's kernels: seconds

    send_messages(path)


def _digest(*parts: Any) -> str:
    total = hashlib.sha256()
    for part in parts:
        total.update(part.encode() if isinstance(part, str) else np.ascontiguousarray(part).tobytes())
    return total.hexdigest()[:16]


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
    """Take longer than half a second."""
    start = time.process_time()
    while time.process_time() < start + 0.6:
        pass


def crash(_: Path) -> None:
    """End the process."""
    os.abort()


TARGETS: dict[str, Callable[[Path], Reading | None]] = {
    "recording": recording,
    "capture": recording,  # decoded by a library in a process of its own: seconds
    "log": flight_log,
    "report": report,
    "points": points,
    "poses": poses,
    "world": world,
    "config": config,
    "solids": solids,
    "port": port,
    "node": node,
    "page": page,
    # Failures that the tests of the harness cause:
    "unnamed": unnamed,
    "traceback": traceback,
    "memory": memory,
    "slow": slow,
    "crash": crash,
}
