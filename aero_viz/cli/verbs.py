"""All verbs of the command line, and here `aero-viz inspect`, `fly`, `snapshot`, `export` and `doctor`."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from aero_viz.cli import bench as bench_verbs
from aero_viz.cli.connect import connect
from aero_viz.cli.flags import ConfigFlags, FileName, FlightFlags, Inline, OutputPath, WorldFlags, WorldName
from aero_viz.cli.page import PageFlags, demo, flight_opener, play, serve
from aero_viz.cli.tune import tune
from aero_viz.errors import UserError

if TYPE_CHECKING:
    from aero_viz.flight import FlightResult

__all__ = ["VERBS"]

_PAGE = PageFlags()
_CONFIG = ConfigFlags()
_FLIGHT = FlightFlags()
_WORLD = WorldFlags()


def inspect(
    file: FileName,
    *,
    points_topic: str | None = None,
    pose_topic: str | None = None,
    json: bool = False,
) -> None:
    """Tell what a recording holds and what of it can be played.

    Args:
        file: MCAP file, ROS 2 bag folder or .db3 file, or ROS 1 .bag file.
        points_topic: topic of the point clouds; found by its type when left out.
        pose_topic: topic of the poses; found by its type when left out.
        json: print one JSON object.
    """
    from aero_viz.recordings import inspect as inspect_recording

    info = inspect_recording(file, points_topic=points_topic, pose_topic=pose_topic)
    _print_json(info.to_json()) if json else print(info.format_table())


def fly(
    world: WorldName,
    *,
    speed: float | None = None,
    lidar: str = "mid360",
    seed: int = 0,
    device: str = "cpu",
    headless: bool = True,
    json: bool = False,
    trajectory: Path | None = None,
    log: Path | None = None,
    place: Inline[WorldFlags] = _WORLD,
    page: Inline[PageFlags] = _PAGE,
    flight: Inline[FlightFlags] = _FLIGHT,
    flags: Inline[ConfigFlags] = _CONFIG,
) -> None:
    """Fly a scene or a world once, as fast as this machine can, and report how it went.

    Ctrl-C ends the flight and reports what was flown so far.

    Args:
        world: name of a scene, such as forest, verticals or inclines, a world's JSON file, a map of points or a mesh.
        speed: speed limit [m/s]; replaces vehicle.speed_limit.
        lidar: mid360, full-sphere or spinning64.
        seed: of the scene, the LiDAR and all noise.
        device: Warp device, such as cpu or cuda:0.
        headless: without the page; --no-headless flies in the browser instead, as demo does.
        json: print one JSON object, and no progress.
        trajectory: CSV file to write, t,x,y,z,vx,vy,vz.
        log: MCAP file to write while flying, for `play`, Foxglove, RViz and PlotJuggler.
        place: the world.
        page: the page.
        flight: the flight.
        flags: the planner's configuration.
    """
    if not headless:
        if json or trajectory is not None:
            raise UserError("--json and --trajectory belong to a headless flight; leave out --no-headless.")
        config = flags.load(place.ground(world, seed=seed))
        config = config if speed is None else config.replace({"vehicle.speed_limit": speed})
        opener = flight_opener(world, place, flight, config, lidar=lidar, device=device)
        return serve(world, opener, config, page, seed=seed, device=device, log=log)
    if page != PageFlags():
        raise UserError("--host, --port, --open and --paused belong to the page; add --no-headless, or leave them out.")
    from aero_viz.flight import FlightInterrupted, ProgressBar
    from aero_viz.flight import fly as fly_once

    loaded = place.load(world, seed=seed)
    config = flags.load(loaded.ground_height)
    bar = ProgressBar(loaded.name)
    options: dict[str, Any] = {
        "config": config,
        "config_name": flags.config,
        "seed": seed,
        "device": device,
        "speed": speed,
        "trajectory": trajectory,
        "progress": None if json else bar.show_way,
        **flight.options(config, lidar=lidar),
    }
    try:
        with contextlib.closing(bar):
            if log is None:
                result = fly_once(loaded, **options)
            else:
                from aero_viz.logs import fly_and_log

                result = fly_and_log(loaded, log, **options)
    except FlightInterrupted as interrupted:
        _print_result(interrupted.result, as_json=json)
        raise SystemExit(130) from None
    _print_result(result, as_json=json)


def snapshot(
    source: WorldName,
    output: OutputPath,
    *,
    time: float = 2.0,
    camera: Literal["follow", "top", "side"] = "follow",
    size: tuple[int, int] = (1600, 1000),
    seed: int = 0,
    device: str = "cpu",
    points_topic: str | None = None,
    pose_topic: str | None = None,
    flags: Inline[ConfigFlags] = _CONFIG,
) -> None:
    """Render a scene or a recording at a given time to a PNG, headless in Chromium.

    Args:
        source: scene, world's JSON file or recording.
        output: PNG file to write.
        time: time in the source [s].
        camera: view.
        size: width and height [pixels].
        seed: of the scene, the LiDAR and the planner's noise.
        device: Warp device of planner and simulation.
        points_topic: topic of the point clouds; found by its type when left out.
        pose_topic: topic of the poses; found by its type when left out.
        flags: the planner's configuration.
    """
    from aero_viz.catalog import open_source
    from aero_viz.dashboard.snapshot import snapshot as take

    opened = open_source(source, seed=seed, device=device, points_topic=points_topic, pose_topic=pose_topic)
    config = flags.load(WorldFlags().ground(source, seed=seed))
    take(opened, time=time, config=config, camera=camera, size=size, path=output, seed=seed, device=device)
    print(output)


def export(
    output: Annotated[OutputPath, tyro.conf.arg(metavar="OUT[.tar]")],
    *,
    config: str = "default",
    arch: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="sm_87")] = (),
    cpu: bool = False,
) -> None:
    """Compile every kernel ahead for a drone that has no compiler, as `aero-planner export` does. No GPU is needed.

    Where this machine has one of the processors itself, the graph for the C++ host comes along.

    Args:
        output: folder or tar file to write.
        config: preset or YAML file; settings of the node stand in it under 'onboard:'.
        arch: of a GPU; may be given several times.
        cpu: for this machine's CPU.
    """
    from aero_planner.cli import write_bundle

    try:
        told = write_bundle(output, config=config, architectures=arch, cpu=cpu)
    except OSError as error:
        raise UserError(f"{output} can't be written: {error.strerror or error}.") from error
    print(told)


def parameters() -> None:
    """Print every planner parameter with symbol, default, range, unit and meaning, as Markdown."""
    from aero_planner.config.docs import format_parameters

    print(format_parameters())


def doctor(*, json: bool = False) -> None:
    """Check this machine: versions, devices, browser, and what is missing with how to get it.

    Args:
        json: print one JSON object.
    """
    from aero_viz.doctor import examine

    report = examine()
    _print_json(report.to_json()) if json else print(report.format_table())
    if not report.healthy:
        raise SystemExit(2)


def _print_json(value: Any) -> None:
    print(json.dumps(value, allow_nan=False))


def _print_result(result: FlightResult, *, as_json: bool) -> None:
    if as_json:
        _print_json(result.to_dict())
    else:
        print(result.format_table())


VERBS: dict[str, Callable[..., None]] = {
    verb.__name__: verb
    for verb in (demo, play, connect, inspect, fly, tune, snapshot, export, parameters, doctor, *bench_verbs.VERBS)
}
"""Function of each verb."""
