"""The command `aero-viz explain`."""

from __future__ import annotations

from typing import Any

from aero_planner.output_files import check_ending, check_output_files, whole_file
from aero_viz.cli.flags import (
    ConfigFlags,
    FlightFlags,
    Inline,
    LidarName,
    LogOrWorldName,
    OptionalFloat,
    OptionalPath,
    WorldFlags,
)
from aero_viz.cli.output import print_report, progress_bar
from aero_viz.errors import UserError

_CONFIG = ConfigFlags()
_FLIGHT = FlightFlags()
_WORLD = WorldFlags()


def explain(
    flight: LogOrWorldName,
    *,
    picture: OptionalPath = None,
    speed: OptionalFloat = None,
    lidar: LidarName = "mid360",
    seed: int = 0,
    device: str = "cpu",
    json: bool = False,
    trajectory: OptionalPath = None,
    log: OptionalPath = None,
    overwrite: bool = False,
    world_flags: Inline[WorldFlags] = _WORLD,
    flight_flags: Inline[FlightFlags] = _FLIGHT,
    config_flags: Inline[ConfigFlags] = _CONFIG,
) -> None:
    """Explain why a flight did not arrive, from its log or by flying it.

    A world is flown first, with the flags of `fly`. The report names the obstacle, says since when it was in the cloud
    or why it was not, and finds the last tick from which braking would have worked.

    Args:
        flight: Flight log (MCAP); or a scene or a world to fly through.
        picture: SVG file to write: a map of the tick that matters most.
        speed: Speed limit [m/s]; overrides vehicle.speed_limit.
        lidar: LiDAR model.
        seed: Seed of the scene, the LiDAR and all noise.
        device: Warp device, such as cpu or cuda:0.
        json: Print one JSON object, and no progress bar.
        trajectory: CSV file to write with the columns t,x,y,z,vx,vy,vz.
        log: MCAP file to write during the flight.
        overwrite: Replace an existing log.
        world_flags: The world.
        flight_flags: The flight.
        config_flags: The planner's configuration.
    """
    from aero_viz.explain.picture import draw_map
    from aero_viz.explain.post_mortem import explain_flight
    from aero_viz.explain.trace import FlightTrace, recorder, trace_of_log
    from aero_viz.flight import FlightInterrupted, fly
    from aero_viz.logs.log_contents import is_flight_log

    inputs = [flight, config_flags.config]
    check_output_files(log, overwrite=overwrite, derived=[picture, trajectory], inputs=inputs)
    check_ending(picture, ".svg", "a picture")
    check_ending(trajectory, ".csv", "a trajectory")
    if flight.endswith(".mcap") or is_flight_log(flight):
        is_flag_set = world_flags != _WORLD or flight_flags != _FLIGHT or config_flags != _CONFIG or speed is not None
        if is_flag_set or trajectory is not None or log is not None or (lidar, seed) != ("mid360", 0):
            raise UserError(
                "A log is explained as it was flown: leave out the flags of the world, the flight and the planner."
            )
        trace = trace_of_log(flight, device=device)
    else:
        trace, config = FlightTrace(), config_flags.load(speed=speed)
        options: dict[str, Any] = {"seed": seed, "device": device, "trajectory": trajectory}
        options |= {"config": config, "config_name": config_flags.name_of(config)}
        options |= flight_flags.options(config, lidar=lidar)
        world = world_flags.load(flight, seed=seed)
        with progress_bar(world.name, enabled=not json) as update_bar:
            options["progress"] = lambda share, time: update_bar(share, 1.0, f"{time:.1f} s flown")
            try:
                fly(world, **options, recorder=recorder(trace, log))
            except FlightInterrupted:
                raise SystemExit(130) from None
    report, evidence = explain_flight(trace)
    print_report(report, as_json=json)
    if picture is not None:
        if evidence is None:
            raise UserError("No picture was written: the flight did not fail. Leave --picture out.")
        is_collision = report.outcome == "collision"
        try:
            with whole_file(picture, alone=True) as partial:
                partial.write_text(draw_map(evidence, trace.end_position if is_collision else None), encoding="utf-8")
        except OSError as error:
            raise UserError(f"The picture {picture} cannot be written: {error.strerror or error}.") from error
