"""The command line: `aero-viz demo`, `play`, `inspect`, `fly`, `snapshot`, `doctor`; more verbs in `cli_bench`."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import threading
import webbrowser
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import tyro

from aero_viz import cli_bench
from aero_viz.cli_config import ConfigFlags
from aero_viz.errors import UserError

if TYPE_CHECKING:
    from aero_viz.dashboard import Dashboard
    from aero_viz.session import Session

__all__ = ["main"]

app = tyro.extras.SubcommandApp()
Positional = tyro.conf.Positional
T = TypeVar("T")
Inline = Annotated[T, tyro.conf.arg(name="")]
"""A group of flags whose names carry no prefix of the group's own."""


@dataclass(frozen=True)
class ServerFlags:
    """The page."""

    host: str = "127.0.0.1"
    """Address to listen on. Anyone who reaches it controls the session: it has no password."""
    port: int = 8080
    """Port to listen on."""
    open: bool = False
    """Open the page in the default browser."""
    paused: bool = False
    """Wait for the play button."""
    device: str = "cpu"
    """Warp device of planner and simulation, such as cpu or cuda:0."""
    seed: int = 0
    """Of the scene, the LiDAR and the planner's noise."""


_SERVER = ServerFlags()
_CONFIG = ConfigFlags()


@app.command
def demo(
    scene: Positional[str] = "forest",
    *,
    count: int | None = None,
    lidar: str = "mid360",
    log: Path | None = None,
    server: Inline[ServerFlags] = _SERVER,
    flags: Inline[ConfigFlags] = _CONFIG,
) -> None:
    """Fly a synthetic scene live in the browser.

    Args:
        scene: name of a scene, such as forest, verticals or inclines, or a world's JSON file.
        count: number of obstacles; the scene's own when left out.
        lidar: mid360, full-sphere or spinning64.
        log: MCAP file to write while flying, for `play`, Foxglove, RViz and PlotJuggler.
        server: the page.
        flags: the planner's configuration.
    """
    _serve(scene, server, flags, log=log, count=count, lidar=lidar)


@app.command
def play(
    recording: Positional[str],
    *,
    points_topic: str | None = None,
    pose_topic: str | None = None,
    goal_ahead: float = 15.0,
    server: Inline[ServerFlags] = _SERVER,
    flags: Inline[ConfigFlags] = _CONFIG,
) -> None:
    """Run the planner on a recording, open loop, live in the browser.

    Args:
        recording: MCAP file, ROS 2 bag folder or .db3 file, or ROS 1 .bag file.
        points_topic: topic of the point clouds; found by its type when left out.
        pose_topic: topic of the poses; found by its type when left out.
        goal_ahead: distance of the goal along the recorded path [m].
        server: the page.
        flags: the planner's configuration.
    """
    from aero_viz.catalog import is_map
    from aero_viz.recordings import open_recording

    if is_map(recording) or Path(recording).suffix.lower() == ".json":
        raise UserError(f"{recording} is a world, not a recording; fly it with: aero-viz demo {recording}")
    if not Path(recording).exists():
        open_recording(recording)
    _serve(recording, server, flags, points_topic=points_topic, pose_topic=pose_topic, goal_ahead=goal_ahead)


@app.command
def inspect(
    file: Positional[str],
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


@app.command
def fly(
    world: Positional[str],
    *,
    speed: float | None = None,
    count: int | None = None,
    lidar: str = "mid360",
    seed: int = 0,
    device: str = "cpu",
    headless: bool = True,
    json: bool = False,
    trajectory: Path | None = None,
    log: Path | None = None,
    flags: Inline[ConfigFlags] = _CONFIG,
) -> None:
    """Fly a scene or a world once, as fast as this machine can, and report how it went.

    Args:
        world: name of a scene, such as forest, verticals or inclines, or a world's JSON file.
        speed: speed limit [m/s]; replaces vehicle.speed_limit.
        count: number of obstacles; the scene's own when left out.
        lidar: mid360, full-sphere or spinning64.
        seed: of the scene, the LiDAR and the planner's noise.
        device: Warp device, such as cpu or cuda:0.
        headless: without the page; --no-headless flies in the browser instead, as demo does.
        json: print one JSON object.
        trajectory: CSV file to write, t,x,y,z,vx,vy,vz.
        log: MCAP file to write while flying, for `play`, Foxglove, RViz and PlotJuggler.
        flags: the planner's configuration.
    """
    if not headless:
        if json or trajectory is not None:
            raise UserError("--json and --trajectory belong to a headless flight; leave out --no-headless.")
        changes = {} if speed is None else {"vehicle.speed_limit": speed}
        server = ServerFlags(seed=seed, device=device)
        return _serve(world, server, flags, changes, log=log, count=count, lidar=lidar)
    from aero_viz.catalog import load_world
    from aero_viz.flight import fly as fly_once
    from aero_viz.sensors import lidar_model

    options: dict[str, Any] = {
        "config": flags.load(),
        "config_name": flags.config,
        "seed": seed,
        "device": device,
        "lidar": lidar_model(lidar),
        "speed": speed,
        "trajectory": trajectory,
    }
    loaded = load_world(world, seed=seed, count=count)
    if log is None:
        result = fly_once(loaded, **options)
    else:
        from aero_viz.logs import fly_and_log

        result = fly_and_log(loaded, log, **options)
    if json:
        _print_json(result.to_dict())
    else:
        for name, value in result.to_dict().items():
            print(f"{name:16} {value:.3f}" if isinstance(value, float) else f"{name:16} {value}")


@app.command
def snapshot(
    source: Positional[str],
    output: Positional[Path],
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
    from aero_viz.snapshot import snapshot as take

    opened = open_source(source, seed=seed, device=device, points_topic=points_topic, pose_topic=pose_topic)
    config = flags.load()
    take(opened, time=time, config=config, camera=camera, size=size, path=output, seed=seed, device=device)
    print(output)


@app.command
def parameters() -> None:
    """Print every planner parameter with symbol, default, range, unit and meaning, as Markdown."""
    from aero_planner.config_docs import format_parameters

    print(format_parameters())


@app.command
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


for verb in cli_bench.VERBS:
    app.command(verb)


def _serve(
    spec: str,
    server: ServerFlags,
    flags: ConfigFlags,
    changes: dict[str, Any] | None = None,
    *,
    log: Path | None = None,
    **options: Any,
) -> None:
    """Serve the page until Ctrl-C or SIGTERM."""
    from aero_viz.catalog import open_source, source_choices
    from aero_viz.dashboard import Dashboard
    from aero_viz.session import Session

    def open_other(other: str) -> Any:
        return open_source(other, seed=server.seed, device=server.device, **(options if other == spec else {}))

    config = flags.load().replace(changes or {})
    session = Session(open_other(spec), config=config, device=server.device, seed=server.seed)
    stopped = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopped.set())
    try:
        choices = [(f"{name}: {text}", name) for name, text in source_choices().items()]
        dashboard = Dashboard(session, host=server.host, port=server.port, open_source=open_other, choices=choices)
        stack = contextlib.ExitStack()
        try:
            if log is not None:
                from aero_viz.logs import record

                stack.enter_context(record(session, log))
            print(f"AERO-Viz shows {spec} at {dashboard.url} (Ctrl-C ends it)", flush=True)
            if server.open:
                webbrowser.open(dashboard.url)
            session.start(play=False)
            if not server.paused:
                _play_when_seen(session, dashboard)
            stopped.wait()
        finally:
            stack.close()
            dashboard.close()
    finally:
        session.close()


def _play_when_seen(session: Session, dashboard: Dashboard) -> None:
    """Let time begin when the first page is open, so that nobody misses the start."""
    seen = threading.Event()

    def begin(_: object) -> None:
        if not seen.is_set():
            seen.set()
            session.play()

    dashboard.server.on_client_connect(begin)


def _print_json(value: Any) -> None:
    print(json.dumps(value, allow_nan=False))


@contextlib.contextmanager
def _quiet_stderr() -> Iterator[None]:
    """Keep what native code writes to stderr off the terminal."""
    sys.stderr.flush()
    saved, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)
    try:
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(null)


def _start_warp() -> None:
    """Start Warp without its banner: stdout belongs to the results, and a missing GPU is no news to a CPU user."""
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING
    with _quiet_stderr():
        wp.init()


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; exits with 0 when done, 2 for a user's mistake or unreadable input."""
    try:
        wanted = sys.argv[1:] if arguments is None else arguments
        if "-h" not in wanted and "--help" not in wanted:
            _start_warp()
        app.cli(prog="aero-viz", description="AERO-Viz: the AERO-MPPI planner, live in the browser.", args=arguments)
        sys.stdout.flush()
    except (UserError, ValueError) as error:
        if isinstance(error, ValueError) and os.environ.get("AERO_VIZ_DEBUG"):
            raise
        print(f"aero-viz: {' '.join(str(error).split())}", file=sys.stderr)
        raise SystemExit(2) from None
    except BrokenPipeError:
        # Whoever read the output has gone, such as `head`; Python would complain once more when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(141) from None
    except KeyboardInterrupt:
        raise SystemExit(130) from None


if __name__ == "__main__":
    main()
