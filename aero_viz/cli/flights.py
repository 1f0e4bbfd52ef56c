"""The commands about single flights: `aero-viz fly` and `score`."""

from __future__ import annotations

import sys
from typing import Any

from aero_planner.output_files import check_ending, check_output_files
from aero_planner.plain_text import say
from aero_viz.cli.flags import (
    ConfigFlags,
    FileName,
    FlightFlags,
    Inline,
    LidarName,
    OptionalFloat,
    OptionalPath,
    OptionalText,
    RulesFlags,
    WorldFlags,
    WorldName,
    flight_rules,
)
from aero_viz.cli.output import print_report, progress_bar
from aero_viz.cli.page import serve_flight
from aero_viz.cli.serving import PageFlags, announce_foxglove
from aero_viz.errors import UserError

_CONFIG = ConfigFlags()
_FLIGHT = FlightFlags()
_PAGE = PageFlags()
_RULES = RulesFlags()
_WORLD = WorldFlags()


def fly(
    world: WorldName,
    *,
    speed: OptionalFloat = None,
    lidar: LidarName = "mid360",
    seed: int = 0,
    device: str = "cpu",
    headless: bool = True,
    json: bool = False,
    trajectory: OptionalPath = None,
    log: OptionalPath = None,
    overwrite: bool = False,
    world_flags: Inline[WorldFlags] = _WORLD,
    page_flags: Inline[PageFlags] = _PAGE,
    flight_flags: Inline[FlightFlags] = _FLIGHT,
    config_flags: Inline[ConfigFlags] = _CONFIG,
) -> None:
    """Fly through a scene or a world once, as fast as possible, and print the result.

    Ctrl-C ends the flight and prints the result so far.

    Args:
        world: Scene, such as forest, verticals or inclines, or file of a world (JSON), point-cloud map or mesh.
        speed: Speed limit [m/s]; overrides vehicle.speed_limit.
        lidar: LiDAR model.
        seed: Seed of the scene, the LiDAR and all noise.
        device: Warp device, such as cpu or cuda:0.
        headless: Fly without the page; --no-headless flies in the browser, as `demo` does.
        json: Print one JSON object, and no progress bar.
        trajectory: CSV file to write with the columns t,x,y,z,vx,vy,vz.
        log: MCAP file to write during the flight, for `play`, Foxglove, RViz and PlotJuggler.
        overwrite: Replace an existing log.
        world_flags: The world.
        page_flags: The page.
        flight_flags: The flight.
        config_flags: The planner's configuration.
    """
    check_output_files(log, overwrite=overwrite, derived=[trajectory], inputs=[world, config_flags.config])
    check_ending(trajectory, ".csv", "a trajectory")
    if not headless:
        if json or trajectory is not None:
            raise UserError("--json and --trajectory apply to headless flights only; leave out --no-headless.")
        flags = (world_flags, flight_flags, config_flags.load(speed=speed), page_flags)
        return serve_flight(world, *flags, lidar=lidar, seed=seed, device=device, log=log)
    port, host = page_flags.foxglove_port, page_flags.host
    used = () if port is None else ("foxglove", "host", "allow_host", "foxglove_origin")
    page_flags.refuse(besides=("ros_out", *used), advice="it is for the page: add --no-headless, or leave it out")
    from aero_viz.flight import FlightInterrupted
    from aero_viz.flight import fly as fly_once

    loaded = world_flags.load(world, seed=seed)
    config = config_flags.load(speed=speed)
    options: dict[str, Any] = {
        "config": config,
        "config_name": config_flags.name_of(config),
        "seed": seed,
        "device": device,
        "trajectory": trajectory,
        **flight_flags.options(config, lidar=lidar),
    }
    try:
        with progress_bar(loaded.name, enabled=not json) as update_bar:

            def show_progress(share: float, flight_time: float) -> None:
                update_bar(share, 1.0, f"{100.0 * share:.0f} % of the distance, {flight_time:.1f} s flown")

            options["progress"] = show_progress
            if log is not None:
                from aero_viz.logs import flight_recorder

                options["recorder"] = flight_recorder(log)
            if port is not None:
                from aero_viz.logs import foxglove_recorder

                options["recorder"] = foxglove_recorder(
                    host,
                    port,
                    log=options.get("recorder"),
                    announce=(lambda _: None) if json else announce_foxglove,
                    **page_flags.foxglove_options,
                )
            if page_flags.ros_out:
                from aero_viz.ros.publishing import ros_recorder

                options["recorder"] = ros_recorder(log=options.get("recorder"))
            result = fly_once(loaded, **options)
    except FlightInterrupted as interrupted:
        print_report(interrupted.result, as_json=json)
        raise SystemExit(130) from None
    print_report(result, as_json=json)


def score(
    flight: FileName,
    *,
    world: str,
    seed: int = 0,
    pose_topic: OptionalText = None,
    planner: str = "recorded",
    table: OptionalPath = None,
    json: bool = False,
    world_flags: Inline[WorldFlags] = _WORLD,
    rules: RulesFlags = _RULES,
) -> None:
    """Score a flight of any planner with the simulator's own metrics.

    Args:
        flight: CSV file with the columns t,x,y,z and optionally vx,vy,vz, or a ROS bag or MCAP file with Odometry.
        world: Where it was flown: scene, or file of a world (JSON), point-cloud map or mesh.
        seed: Seed of the scene.
        pose_topic: Topic of the poses; by default it is found by its type.
        planner: Name of the planner that flew, for the result.
        table: CSV file to append the result to, for `bench --include`.
        json: Print one JSON object.
        world_flags: The world.
        rules: The rules by which a flight ends.
    """
    from aero_viz.evaluation.bench.external_results import append_to_table
    from aero_viz.evaluation.score import load_trajectory, other_world
    from aero_viz.evaluation.score import score as score_flight

    limits, loaded = flight_rules(rules), world_flags.load(world, seed=seed)
    if problem := other_world(flight, loaded):
        say(f"aero-viz: {problem}", file=sys.stderr)
    result = score_flight(
        load_trajectory(flight, pose_topic=pose_topic), loaded, rules=limits, planner=planner, seed=seed
    )
    if table is not None:
        append_to_table(result, table)
    print_report(result, as_json=json)
