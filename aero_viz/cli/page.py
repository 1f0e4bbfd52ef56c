"""The commands that serve the page: `aero-viz demo`, `play` and `connect`. `fly --no-headless` uses them, too."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from aero_planner.cli_util import quick_imports
from aero_planner.output_files import check_output_files
from aero_viz.cli.flags import (
    ConfigFlags,
    FlightFlags,
    Inline,
    LidarName,
    OptionalFileName,
    OptionalFloat,
    OptionalPath,
    RecordingFlags,
    WorldFlags,
    WorldName,
)
from aero_viz.cli.output import progress_bar
from aero_viz.cli.serving import (
    WATCHING,
    PageFlags,
    StudyFlags,
    announce,
    play_when_drawn,
    serve_others,
    shutdown_event,
    wait_for,
)
from aero_viz.errors import UserError
from aero_viz.reader_process import read_here

if TYPE_CHECKING:
    from aero_planner.config import DroneConfig
    from aero_viz.reader_process import Reader
    from aero_viz.session import Session
    from aero_viz.session.source import Conditions, Opener, Source

_PAGE = PageFlags()
_CONFIG = ConfigFlags()
_FLIGHT = FlightFlags()
_RECORDING = RecordingFlags()
_STUDY = StudyFlags()
_WORLD = WorldFlags()
_STARTING = "The planner is starting. Compiling kernels that are new to this machine takes a minute."
"""Text on a page that is opened before there is anything to show."""


def demo(
    scene: WorldName = "forest",
    *,
    tour: bool = False,
    speed: OptionalFloat = None,
    lidar: LidarName = "mid360",
    seed: int = 0,
    device: str = "cpu",
    log: OptionalPath = None,
    overwrite: bool = False,
    world_flags: Inline[WorldFlags] = _WORLD,
    page_flags: Inline[PageFlags] = _PAGE,
    study_flags: Inline[StudyFlags] = _STUDY,
    flight_flags: Inline[FlightFlags] = _FLIGHT,
    config_flags: Inline[ConfigFlags] = _CONFIG,
) -> None:
    """Fly a synthetic scene live in the browser.

    Args:
        scene: Scene, such as forest, verticals or inclines, or file of a world (JSON), point-cloud map or mesh.
        tour: Loop through scenes for an exhibition screen, with captions and a moving camera, and without panels.
        speed: Speed limit [m/s]; overrides vehicle.speed_limit.
        lidar: LiDAR model.
        seed: Seed of the scene, the LiDAR and all noise.
        device: Warp device of planner and simulation, such as cpu or cuda:0.
        log: MCAP file to write during the flight, for `play`, Foxglove, RViz and PlotJuggler.
        overwrite: Replace an existing log.
        world_flags: The world.
        page_flags: The page.
        study_flags: A study of `aero-viz tune`, as a tab of the page.
        flight_flags: The flight.
        config_flags: The planner's configuration.
    """
    if tour:
        if log is not None or world_flags != WorldFlags() or scene != "forest" or study_flags.study is not None:
            raise UserError(
                "--tour has its own scenes; leave out the scene, the flags of the world, --study and --log."
            )
        if page_flags.paused or page_flags.folder:
            raise UserError("--tour always plays and opens no files; leave out --paused and --folder.")
        from aero_viz.cli.tour import serve_tour

        config = config_flags.load(speed=speed)
        opener = flight_opener(scene, WorldFlags(), flight_flags, config, lidar=lidar, device=device)
        return serve_tour(opener, config, page_flags, seed=seed, device=device)
    check_output_files(log, overwrite=overwrite, inputs=[scene, config_flags.config])
    flags = (world_flags, flight_flags, config_flags.load(speed=speed), page_flags)
    serve_flight(scene, *flags, lidar=lidar, seed=seed, device=device, log=log, study=study_flags)


def play(
    recording: OptionalFileName = None,
    *,
    goal_ahead: float = 15.0,
    seed: int = 0,
    device: str = "cpu",
    recording_flags: Inline[RecordingFlags] = _RECORDING,
    page_flags: Inline[PageFlags] = _PAGE,
    study_flags: Inline[StudyFlags] = _STUDY,
    config_flags: Inline[ConfigFlags] = _CONFIG,
) -> None:
    """Run the planner on a recording, open loop, live in the browser.

    Args:
        recording: ROS bag, MCAP file, folder or file of clouds, or capture of packets; by default a flight that ships.
        goal_ahead: Distance of the goal from the drone along the recorded path [m].
        seed: Seed of the planner's noise.
        device: Warp device of the planner.
        recording_flags: The recording.
        page_flags: The page.
        study_flags: A study of `aero-viz tune`, as a tab of the page.
        config_flags: The planner's configuration.
    """
    from aero_viz.catalog import open_source, shipped_recordings
    from aero_viz.live.replay import is_stream_recording, recorded_config
    from aero_viz.recordings import open_recording
    from aero_viz.scenes import SCENES
    from aero_viz.scenes.map_files import MESH_SUFFIXES

    if recording is None:
        recording = str(next(iter(shipped_recordings().values()))[0])
    if Path(recording).suffix.lower() in (*MESH_SUFFIXES, ".json"):
        raise UserError(f"{recording} is a world, not a recording; fly it with: aero-viz demo {recording}")
    if not Path(recording).exists():
        if recording in SCENES:
            raise UserError(f"{recording} is a scene, not a recording; fly it with: aero-viz demo {recording}")
        open_recording(recording)

    def opener(spec: str, *, seed: int, read: Reader = read_here, conditions: Conditions | None = None) -> Source:
        if not _is_same(spec, recording):
            return open_source(spec, seed=seed, device=device, goal_ahead=goal_ahead, read=read, conditions=conditions)
        with progress_bar("estimating the motion", enabled=recording_flags.estimates_motion) as update_bar:
            options = recording_flags.options()
            options["progress"] = lambda done, total: update_bar(done, total, f"{done} of {total} sweeps")
            return open_source(
                spec,
                seed=seed,
                device=device,
                goal_ahead=goal_ahead,
                as_recording=True,
                recording_options=options,
                read=read,
            )

    config = config_flags.load()
    if config == ConfigFlags().load() and is_stream_recording(recording):
        config = recorded_config(recording) or config  # the same plans come of it
    serve(recording, opener, config, page_flags, seed=seed, device=device, study=study_flags)


def connect(
    drone: tyro.conf.Positional[Annotated[str, tyro.conf.arg(metavar="HOST")]],
    *,
    drone_port: int = 14650,
    key: OptionalPath = None,
    page_flags: Inline[PageFlags] = _PAGE,
) -> None:
    """Show the live plan of a drone that runs `aero-planner run`.

    The page only watches, but who holds the node's key can change the parameters that tuning.limits allows.

    Args:
        drone: Name or address of the drone. It must run with telemetry.host: 0.0.0.0 or behind an SSH tunnel.
        drone_port: TCP port of the drone's telemetry.
        key: File with the key, as tuning.key_file of the node.
        page_flags: The page.
    """
    from aero_planner.onboard.mavlink_signing import load_key
    from aero_viz.dashboard import Dashboard
    from aero_viz.session.live_session import LiveSession
    from aero_viz.session.node_client import NodeClient

    page_flags.refuse(besides=WATCHING, advice="the page of a drone opens no files: leave it out")
    secret = None if key is None else load_key(key, "--key")

    def open_client() -> NodeClient:
        return NodeClient(drone, drone_port, key=secret)

    with contextlib.ExitStack() as stack:
        session = LiveSession(open_client(), reconnect=open_client)
        stack.callback(session.close)
        shutdown = shutdown_event()
        dashboard = Dashboard(session, **page_flags.server_options)
        stack.callback(dashboard.close)
        serve_others(stack, session, page_flags)
        announce(drone, dashboard.server, page_flags)
        session.start(play=not page_flags.paused)
        wait_for(shutdown)


def serve_flight(
    spec: str,
    world_flags: WorldFlags,
    flight_flags: FlightFlags,
    config: DroneConfig,
    page_flags: PageFlags,
    *,
    lidar: str,
    seed: int,
    device: str,
    log: OptionalPath = None,
    study: StudyFlags = _STUDY,
) -> None:
    """Serve the page of a flight until Ctrl-C or SIGTERM. The page offers the conditions of the flags at first."""
    from aero_viz.flight.conditions import conditions_of

    opener = flight_opener(spec, world_flags, flight_flags, config, lidar=lidar, device=device)
    conditions = conditions_of(flight_flags.options(config, lidar=lidar), count=world_flags.count)
    options: dict[str, Any] = {"log": log, "conditions": conditions, "study": study}
    serve(spec, opener, config, page_flags, seed=seed, device=device, **options)


def flight_opener(
    spec: str, world_flags: WorldFlags, flight_flags: FlightFlags, config: DroneConfig, *, lidar: str, device: str
) -> Opener:
    """Return a function that opens sources by name.

    It opens `spec` with the world flags, and every other scene or world that the page asks for without them, but with
    the same drone and LiDAR.
    """
    from aero_viz.catalog import is_recording, open_source
    from aero_viz.flight import FlightSource
    from aero_viz.flight.conditions import with_conditions
    from aero_viz.flight.explanation import refuse_impossible
    from aero_viz.scenes import SCENES

    options = flight_flags.options(config, lidar=lidar)

    def opener(name: str, *, seed: int, read: Reader = read_here, conditions: Conditions | None = None) -> Source:
        is_first = _is_same(name, spec)
        if not is_first and is_recording(name):
            return open_source(name, seed=seed, device=device, read=read)
        load = read_here if name in SCENES else read
        flags, chosen = world_flags if is_first else WorldFlags(), options
        if conditions is not None:
            flags, chosen = dataclasses.replace(flags, count=conditions.count), with_conditions(options, conditions)
        world = load(flags.load, name, seed=seed)
        limit = config.vehicle.speed_limit
        refuse_impossible(world, rules=options["rules"], speed_limit=limit, must_arrive=False)
        return FlightSource(world, seed=seed, device=device, control_step=config.control_step, **chosen)

    return opener


def _is_same(first: str, second: str) -> bool:
    """Return True if two names are equal or paths of one file."""
    return first == second or (Path(second).exists() and Path(first).resolve() == Path(second).resolve())


def serve(
    spec: str,
    opener: Opener,
    config: DroneConfig,
    page_flags: PageFlags,
    *,
    seed: int,
    device: str,
    log: OptionalPath = None,
    conditions: Conditions | None = None,
    study: StudyFlags = _STUDY,
    watch: Callable[[Session], object] = lambda session: None,
) -> None:
    """Serve the page for the source `spec` until Ctrl-C or SIGTERM. `watch` is called with the session at first.

    The server starts before the planner does, so that a browser loads the page meanwhile, and what is needed for the
    first picture comes before the rest. Modules are imported in that order.
    """
    with contextlib.ExitStack() as stack:
        with quick_imports():
            # Errors in the flags come before the address; those of the session, the log and Foxglove after it.
            shown_study, folders = study.open(), _folders(spec, page_flags)
            from aero_planner.warp_init import find_device

            find_device(device)
            page_flags.check()

            from aero_viz.dashboard import LocalServer

            server = LocalServer(**page_flags.server_options)
            stack.callback(server.stop)
            note = server.gui.add_markdown(_STARTING)
            source = opener(spec, seed=seed)
            try:
                announce(spec, server, page_flags)
                session = _open_session(stack, source, config, device=device, seed=seed, log=log)
            except KeyboardInterrupt:
                return  # also while kernels are compiled
            shutdown = shutdown_event()
            is_watched = serve_others(stack, session, page_flags)
            watch(session)
            session.start(play=False)

            from aero_viz.dashboard.first_picture import show_first_picture

            drawn = show_first_picture(session, server, is_over=shutdown.is_set)
            if shutdown.is_set():
                return
            note.remove()

            from aero_viz.dashboard import Dashboard
            from aero_viz.dashboard.share import FlightFiles
            from aero_viz.session.source import Conditions

            dashboard = Dashboard(
                session,
                server=server,
                drawn=drawn,
                open_source=opener,
                choices=_choices(),
                seed=seed,
                opened=spec,
                conditions=conditions or Conditions(),
                folders=folders,
                files=FlightFiles(),
                study=shown_study,
            )
            stack.callback(dashboard.close)
            start = (lambda: None) if page_flags.paused else play_when_drawn(session, dashboard)
        wait_for(shutdown, lambda: start() if is_watched() else None)


def _open_session(
    stack: contextlib.ExitStack, source: Source, config: DroneConfig, *, device: str, seed: int, log: OptionalPath
) -> Session:
    """Open a session, and its log if there is one; the stack closes both."""
    from aero_viz.flight.known_drone import config_for_flight
    from aero_viz.session import Session

    session = Session(source, config=config_for_flight(config, source.info), device=device, seed=seed)
    stack.callback(session.close)
    if log is not None:
        from aero_viz.logs import record

        stack.enter_context(record(session, log))
    return session


def _choices() -> list[tuple[str, str]]:
    """Return what the page offers to open: text, and name or path."""
    from aero_viz.catalog import shipped_recordings
    from aero_viz.scenes import SCENES

    return [
        *((f"{name}: {kind.description}", name) for name, kind in SCENES.items()),
        *((f"{name}: {text}", str(path)) for name, (path, text) in shipped_recordings().items()),
    ]


def _folders(spec: str, page_flags: PageFlags) -> list[Path]:
    """Return the folders that the page may open: of the flags, of the first file, datasets/, and what ships.

    Raises:
        UserError: a folder of the flags does not exist.
    """
    for folder in page_flags.folder:
        if not folder.expanduser().is_dir():
            raise UserError(f"{folder} is not a folder; give --folder a folder whose files the page may open.")
    from aero_viz.catalog import SHIPPED_FOLDER

    first = [Path(spec).resolve().parent] if Path(spec).exists() else []
    return [*page_flags.folder, *first, Path("datasets"), SHIPPED_FOLDER]
