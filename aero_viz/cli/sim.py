"""The command `aero-viz sim`: the simulator as a node of ROS 2."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

from aero_planner.output_files import check_output_files
from aero_viz.cli.flags import (
    ConfigFlags,
    FlightFlags,
    Inline,
    LidarName,
    OptionalFloat,
    OptionalPath,
    WorldFlags,
    WorldName,
    config_flags_type,
)
from aero_viz.cli.flights import fly
from aero_viz.cli.output import print_report
from aero_viz.cli.page import flight_opener, serve
from aero_viz.cli.serving import PageFlags
from aero_viz.errors import UserError

if TYPE_CHECKING:
    from aero_viz.session import Session
    from aero_viz.session.frame import Frame

_ROS = "ros"
"""Name of the planner that asks ROS 2."""
_CONFIG = config_flags_type(_ROS)(planner=_ROS)
_FLIGHT = FlightFlags()
_PAGE = PageFlags()
_WORLD = WorldFlags()


def sim(
    scene: WorldName = "forest",
    *,
    ros: bool = False,
    headless: bool = False,
    speed: OptionalFloat = None,
    lidar: LidarName = "mid360",
    seed: int = 0,
    device: str = "cpu",
    json: bool = False,
    log: OptionalPath = None,
    overwrite: bool = False,
    world_flags: Inline[WorldFlags] = _WORLD,
    page_flags: Inline[PageFlags] = _PAGE,
    flight_flags: Inline[FlightFlags] = _FLIGHT,
    config_flags: Inline[ConfigFlags] = _CONFIG,
) -> None:
    """Fly what a program of ROS 2 commands, in real time, and judge it.

    Publishes /points, /odometry, /tf, /clock and /goal_pose, and obeys /cmd_vel, /command/velocity,
    /command/acceleration, /command/path, /command/trajectory and /mavros/setpoint_raw/attitude. The flight begins with
    the first command; its result is printed at its end. `bench --planner ros` flies a benchmark in the same way.

    Args:
        scene: Scene, such as forest, verticals or inclines, or file of a world (JSON), point-cloud map or mesh.
        ros: Take part in ROS 2. There is no other way yet to command the drone, so it is required.
        headless: Fly once without the page.
        speed: Speed limit [m/s]; overrides vehicle.speed_limit.
        lidar: LiDAR model.
        seed: Seed of the scene, the LiDAR and all noise.
        device: Warp device of the simulation, such as cpu or cuda:0.
        json: Print each result as one JSON object.
        log: MCAP file to write during the flight, for `play`, Foxglove, RViz and PlotJuggler.
        overwrite: Replace an existing log.
        world_flags: The world.
        page_flags: The page.
        flight_flags: The flight.
        config_flags: How commands are followed.
    """
    if not ros or config_flags.planner != _ROS:
        raise UserError("sim flies what a program of ROS 2 commands: add --ros, and no --planner; demo flies planners.")
    if page_flags.ros_out:
        raise UserError("sim publishes the drone's pose itself: leave --ros-out out.")
    dataclasses.replace(page_flags, ros_out=True).check()  # that there is a ROS 2
    if headless:
        options: dict[str, Any] = {"speed": speed, "lidar": lidar, "seed": seed, "device": device, "json": json}
        groups = {"world_flags": world_flags, "page_flags": page_flags, "flight_flags": flight_flags}
        return fly(scene, **options, **groups, log=log, overwrite=overwrite, config_flags=config_flags)
    check_output_files(log, overwrite=overwrite, inputs=[scene, config_flags.config])
    from aero_viz.flight.conditions import conditions_of

    config, flown = config_flags.load(speed=speed), _Flown(config_flags, as_json=json)
    open_flight = flight_opener(scene, world_flags, flight_flags, config, lidar=lidar, device=device)
    serve(
        scene,
        lambda *arguments, **options: flown.keep(open_flight(*arguments, **options)),
        config,
        page_flags,
        seed=seed,
        device=device,
        log=log,
        conditions=conditions_of(flight_flags.options(config, lidar=lidar), count=world_flags.count),
        watch=flown.watch,
    )


class _Flown:
    """Prints the result of every flight on the page when it ends."""

    def __init__(self, flags: ConfigFlags, *, as_json: bool) -> None:
        self._flags, self._as_json = flags, as_json
        self._source: Any = None
        self._printed: tuple[int, float] | None = None

    def keep(self, source: Any) -> Any:
        """Return a source that was opened, whose flight is the next one."""
        self._source = source
        return source

    def watch(self, session: Session) -> None:
        """Print the result of each flight of the session."""
        session.subscribe(self._show, every=True, name="result")

    def _show(self, frame: Frame) -> None:
        if frame.outcome is None or self._printed == (frame.epoch, frame.time):
            return
        self._printed = (frame.epoch, frame.time)
        from aero_viz.flight import FlightSource
        from aero_viz.session.engine import PLANNER_FAILED

        if isinstance(self._source, FlightSource):
            result = dataclasses.replace(self._source.result(), config=self._flags.name_of(frame.config))
            if frame.outcome == PLANNER_FAILED:
                result = dataclasses.replace(result, reason=PLANNER_FAILED, explanation=frame.explanation)
            print_report(result, as_json=self._as_json)
