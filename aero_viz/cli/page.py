"""Verbs that open the page: `aero-viz demo`, `play`, and what `fly --no-headless` shares with them."""

from __future__ import annotations

import contextlib
import signal
import threading
import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from aero_viz.cli.flags import ConfigFlags, FileName, FlightFlags, Inline, WorldFlags, WorldName
from aero_viz.errors import UserError

if TYPE_CHECKING:
    from aero_planner import PlannerConfig
    from aero_viz.dashboard import Dashboard
    from aero_viz.session import Session
    from aero_viz.session.source import Opener, Source

__all__ = ["PageFlags", "demo", "flight_opener", "play", "serve", "told_to_end"]


@dataclass(frozen=True)
class PageFlags:
    """The page."""

    host: str = "127.0.0.1"
    """Address to listen on. Anyone who reaches it controls the session: it has no password."""
    port: int = 8080
    """Port to listen on."""
    open: bool = False
    """Open the page in the default browser."""
    paused: bool = False
    """Wait for the play button."""


_PAGE = PageFlags()
_CONFIG = ConfigFlags()
_FLIGHT = FlightFlags()
_WORLD = WorldFlags()


def demo(
    scene: WorldName = "forest",
    *,
    lidar: str = "mid360",
    seed: int = 0,
    device: str = "cpu",
    log: Path | None = None,
    world: Inline[WorldFlags] = _WORLD,
    page: Inline[PageFlags] = _PAGE,
    flight: Inline[FlightFlags] = _FLIGHT,
    flags: Inline[ConfigFlags] = _CONFIG,
) -> None:
    """Fly a synthetic scene live in the browser.

    Args:
        scene: name of a scene, such as forest, verticals or inclines, a world's JSON file, a map of points or a mesh.
        lidar: mid360, full-sphere or spinning64.
        seed: of the scene, the LiDAR and all noise.
        device: Warp device of planner and simulation, such as cpu or cuda:0.
        log: MCAP file to write while flying, for `play`, Foxglove, RViz and PlotJuggler.
        world: the world.
        page: the page.
        flight: the flight.
        flags: the planner's configuration.
    """
    config = flags.load(world.ground(scene, seed=seed))
    serve(
        scene,
        flight_opener(scene, world, flight, config, lidar=lidar, device=device),
        config,
        page,
        seed=seed,
        device=device,
        log=log,
    )


def play(
    recording: FileName,
    *,
    points_topic: str | None = None,
    pose_topic: str | None = None,
    goal_ahead: float = 15.0,
    seed: int = 0,
    device: str = "cpu",
    page: Inline[PageFlags] = _PAGE,
    flags: Inline[ConfigFlags] = _CONFIG,
) -> None:
    """Run the planner on a recording, open loop, live in the browser.

    Args:
        recording: MCAP file, ROS 2 bag folder or .db3 file, or ROS 1 .bag file.
        points_topic: topic of the point clouds; found by its type when left out.
        pose_topic: topic of the poses; found by its type when left out.
        goal_ahead: distance of the goal along the recorded path [m].
        seed: of the planner's noise.
        device: Warp device of the planner.
        page: the page.
        flags: the planner's configuration.
    """
    from aero_viz.catalog import is_map, open_source
    from aero_viz.recordings import open_recording
    from aero_viz.scenes import SCENES

    if is_map(recording) or Path(recording).suffix.lower() == ".json":
        raise UserError(f"{recording} is a world, not a recording; fly it with: aero-viz demo {recording}")
    if not Path(recording).exists():
        if recording in SCENES:
            raise UserError(f"{recording} is a scene, not a recording; fly it with: aero-viz demo {recording}")
        open_recording(recording)

    def open_other(spec: str, *, seed: int) -> Source:
        points, poses = (points_topic, pose_topic) if spec == recording else (None, None)
        return open_source(spec, seed=seed, device=device, points_topic=points, pose_topic=poses, goal_ahead=goal_ahead)

    serve(recording, open_other, flags.load(), page, seed=seed, device=device)


def flight_opener(
    spec: str,
    world: WorldFlags,
    flight: FlightFlags,
    config: PlannerConfig,
    *,
    lidar: str,
    device: str,
) -> Opener:
    """Return what opens `spec` as the flags say, and every other source that the page asks for with the same drone."""
    from aero_viz.catalog import is_map, open_source
    from aero_viz.flight import FlightSource
    from aero_viz.flight.explanation import refuse_impossible
    from aero_viz.scenes import SCENES

    options = flight.options(config, lidar=lidar)

    def open_other(other: str, *, seed: int) -> Source:
        if other != spec and not (other in SCENES or other.endswith(".json") or is_map(other)):
            return open_source(other, seed=seed, device=device)
        loaded = (world if other == spec else WorldFlags()).load(other, seed=seed)
        refuse_impossible(loaded, rules=options["rules"], speed_limit=config.vehicle.speed_limit)
        return FlightSource(loaded, seed=seed, device=device, control_step=config.sampling.dt, **options)

    return open_other


def serve(
    spec: str,
    open_other: Opener,
    config: PlannerConfig,
    page: PageFlags,
    *,
    seed: int,
    device: str,
    log: Path | None = None,
) -> None:
    """Serve the page until Ctrl-C or SIGTERM."""
    from aero_viz.catalog import source_choices
    from aero_viz.dashboard import Dashboard
    from aero_viz.session import Session

    session = Session(open_other(spec, seed=seed), config=config, device=device, seed=seed)
    stopped = told_to_end()
    try:
        choices = [(f"{name}: {text}", name) for name, text in source_choices().items()]
        dashboard = Dashboard(
            session, host=page.host, port=page.port, open_source=open_other, choices=choices, seed=seed
        )
        stack = contextlib.ExitStack()
        try:
            if log is not None:
                from aero_viz.logs import record

                stack.enter_context(record(session, log))
            print(f"AERO-Viz shows {spec} at {dashboard.url} (Ctrl-C ends it)", flush=True)
            if page.open:
                webbrowser.open(dashboard.url)
            session.start(play=False)
            if not page.paused:
                _play_when_seen(session, dashboard)
            stopped.wait()
        finally:
            stack.close()
            dashboard.close()
    finally:
        session.close()


def told_to_end() -> threading.Event:
    """Return what Ctrl-C or SIGTERM sets, so that all is closed in order; the second one ends the program at once."""
    stopped = threading.Event()
    ending = (signal.SIGINT, signal.SIGTERM)

    def end(*_: object) -> None:
        for number in ending:
            signal.signal(number, signal.SIG_DFL)
        stopped.set()

    for number in ending:
        signal.signal(number, end)
    return stopped


def _play_when_seen(session: Session, dashboard: Dashboard) -> None:
    """Let time begin when the first page is open, so that nobody misses the start."""
    seen = threading.Event()

    def begin(_: object) -> None:
        if not seen.is_set():
            seen.set()
            session.play()

    dashboard.server.on_client_connect(begin)
