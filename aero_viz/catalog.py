"""Sources and worlds by name: scenes, world files, maps and recordings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from aero_planner.config import PlannerConfig
from aero_viz.errors import UserError
from aero_viz.reader_process import Reader, read_here
from aero_viz.session.source import Conditions, Source

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import ArrayLike, NDArray

    from aero_viz.scenes import World

_SHIPPED = {
    "forest_mid360": "recorded flight through the forest, Mid-360",
    "room_mid360": "one recorded second in a room, Mid-360",
}
"""Recordings that ship, with descriptions; `aero-viz play` opens the first. datasets/make.py writes them."""
SHIPPED_FOLDER = Path(__file__).parent / "datasets"
"""Folder of these recordings, a part of the package."""
_BAGS = (".mcap", ".db3", ".bag")


def shipped_recordings() -> dict[str, tuple[Path, str]]:
    """Return paths and descriptions of the recordings that ship, by name."""
    return {name: (SHIPPED_FOLDER / f"{name}.mcap", text) for name, text in _SHIPPED.items()}


def is_map(spec: str) -> bool:
    """Return True if `spec` is the file name of a point map, a mesh, a Gazebo world or an occupancy image."""
    from aero_viz.scenes.map_files import MAP_SUFFIXES, SOLID_SUFFIXES

    return Path(spec).suffix.lower() in (*MAP_SUFFIXES, *SOLID_SUFFIXES) and not Path(spec).is_dir()


def is_recording(spec: str) -> bool:
    """Return True if `spec` is a path that is neither a scene nor a file of a world; there may be no file."""
    from aero_viz.scenes import SCENES

    return spec not in SCENES and _is_path(spec) and not (spec.endswith(".json") or is_map(spec))


def is_bag(spec: str) -> bool:
    """Return True for the file or folder of a bag, which is a world if it holds a single cloud."""
    return Path(spec).exists() and (Path(spec).suffix.lower() in _BAGS or (Path(spec) / "metadata.yaml").is_file())


def _is_path(spec: str) -> bool:
    """Return True if `spec` can only be a path, or is one of a file or folder."""
    return spec != "" and ("/" in spec or Path(spec).suffix != "" or Path(spec).exists())


def refuse_irregular(spec: str) -> None:
    """Refuse pipes, devices and sockets: opening one may block forever, and reading one changes it.

    Raises:
        UserError: `spec` is the path of one.
    """
    path = Path(spec).expanduser()
    if path.exists() and not path.is_file() and not path.is_dir():
        raise UserError(f"{spec} is not a regular file; copy its content to a file first.")


def load_world(
    spec: str,
    *,
    seed: int = 0,
    count: int | None = None,
    voxel: float | None = None,
    start: ArrayLike | None = None,
    goal: ArrayLike | None = None,
    across: bool = False,
) -> World:
    """Return the world of a scene, a JSON file, a point map, a mesh, a Gazebo world, an image, or a bag of one cloud.

    Args:
        spec: name of a scene, or path of a file.
        seed: seed of a scene.
        count: number of obstacles of a scene; None is its default.
        voxel: edge of the voxels of a point map or of the pixels of an image [m], see `load_map`; ignored for others.
        start, goal: [m], [3]; None leaves them to the world, or the choice to `load_map`.
        across: choice of start and goal, see `load_map`.

    Raises:
        UserError: there is no such scene or file, or the file is malformed.
    """
    from aero_viz.scenes import SCENES, load_map, scene
    from aero_viz.scenes.map_files import has_voxels

    refuse_irregular(spec)
    is_file = spec not in SCENES and _is_path(spec)
    if is_file and count is not None:
        raise UserError(f"--count applies to generated scenes only, and {spec} is a file; leave it out.")
    if is_map(spec):
        return load_map(spec, voxel=voxel if has_voxels(spec) else None, start=start, goal=goal, across=across)
    if is_file and is_bag(spec):
        return load_map(spec, voxel=voxel, start=start, goal=goal, across=across, points=read_cloud(spec))
    world = _load_file(spec) if is_file else scene(spec, seed=seed, count=count)
    try:
        world = world if start is None else replace(world, start=start)
        return world if goal is None else world.with_goal(goal)
    except ValueError as error:
        raise UserError(f"{spec}: {error}") from error


def read_cloud(spec: str) -> NDArray[np.float64]:
    """Return the points of a point map or of a bag of one cloud [n, 3] [m].

    Raises:
        UserError: there is no such file, it is malformed, or it holds no points.
    """
    from aero_viz.recordings.map_cloud import read_map_cloud
    from aero_viz.scenes.map_files import read_map

    refuse_irregular(spec)
    if is_bag(spec):
        try:
            return read_map_cloud(spec)
        except UserError as error:
            raise UserError(
                f"{spec} is not a world: {error} If it is a recording, play it with: aero-viz play {spec}"
            ) from error
    points = read_map(spec)
    if points.shape[1] != 3:
        raise UserError(f"{spec} is a mesh, and a cloud of points is needed; give a file of its points.")
    return points


def _load_file(path: str) -> World:
    """Read a world's JSON file; the error for another file says how to play a recording."""
    from aero_viz.scenes import World

    try:
        return World.load(path)
    except UserError as error:
        if not isinstance(error.__cause__, (UnicodeDecodeError, IsADirectoryError)):
            raise
        raise UserError(f"{error} If it is a recording, play it with: aero-viz play {path}") from error


def open_source(
    spec: str,
    *,
    seed: int = 0,
    device: str = "cpu",
    count: int | None = None,
    lidar: str = "mid360",
    points_topic: str | None = None,
    pose_topic: str | None = None,
    goal_ahead: float = 15.0,
    as_recording: bool = False,
    recording_options: Mapping[str, Any] = MappingProxyType({}),
    read: Reader = read_here,
    conditions: Conditions | None = None,
) -> Source:
    """Open a scene, a world's JSON file, a map, or a recording.

    Args:
        spec: name of a scene, or path of a file.
        seed: seed of the scene, the LiDAR and its noise.
        device: Warp device of the simulation.
        count: number of obstacles of a scene; None is its default.
        lidar: LiDAR model of a flight, see `aero_viz.sensors.lidar.lidar_model`.
        points_topic, pose_topic: topics of a recording; None finds them by type.
        goal_ahead: distance from the drone to the goal of a recording [m].
        as_recording: True opens a file of points as a recording of one sweep, not as a map to fly through.
        recording_options: other arguments of `aero_viz.recordings.open_recording`.
        read: reads a file, here or in another process.
        conditions: conditions of a flight, which replace `count` and `lidar`; None leaves them.

    Raises:
        UserError: the source does not exist or cannot be used, or no flight in it can arrive.
    """
    from aero_viz.scenes import SCENES

    if not as_recording and not is_recording(spec):
        from aero_viz.flight import FlightRules, FlightSource, VehicleModel
        from aero_viz.flight.conditions import with_conditions
        from aero_viz.flight.explanation import refuse_impossible
        from aero_viz.sensors import lidar_model

        load = read_here if spec in SCENES else read
        options: dict[str, Any] = {
            "lidar": lidar_model(lidar),
            "vehicle": VehicleModel.from_config(PlannerConfig()),
            "noise": None,
        }
        if conditions is not None:
            count, options = conditions.count, with_conditions(options, conditions)
        world = load(load_world, spec, seed=seed, count=count)
        # The configuration is not known yet: refuse only what no configuration can reach.
        limit = PlannerConfig.find("vehicle.speed_limit").high
        refuse_impossible(world, rules=FlightRules(), speed_limit=limit, must_arrive=False)
        return FlightSource(world, seed=seed, device=device, **options)
    from aero_viz.live.replay import StreamReplay, is_stream_recording
    from aero_viz.logs.log_contents import is_flight_log
    from aero_viz.logs.replay import FlightReplay
    from aero_viz.recordings import RecordingSource, open_recording
    from aero_viz.recordings.index import index_recording, open_indexed

    refuse_irregular(spec)
    topics = {"points_topic": points_topic, "pose_topic": pose_topic}
    settled = {**topics, **recording_options, "progress": None}
    if is_stream_recording(spec) and all(value in (None, "none", "auto") for value in settled.values()):
        return StreamReplay(spec, read=None if read is read_here else read)
    if read is read_here or recording_options:
        recording = open_recording(spec, **{**topics, **recording_options})
    else:
        recording = open_indexed(spec, read(index_recording, spec), **topics)
    try:
        if is_flight_log(spec):
            own = None if read is read_here else read
            return FlightReplay(recording, spec, goal_ahead=goal_ahead, read=own)
        return RecordingSource(recording, goal_ahead=goal_ahead)
    except Exception:
        recording.close()
        raise
