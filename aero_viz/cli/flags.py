"""Groups of command-line flags, most of which derive from the parameters of planner, drone, LiDAR, noise and rules."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from aero_planner import PlannerConfig
from aero_planner.config import DroneConfig, ParameterInfo
from aero_planner.config.file import config_from_name
from aero_viz.catalog import is_bag, is_map, load_world
from aero_viz.cli.missions import WaypointTexts, chosen_mission, fly_through
from aero_viz.errors import UserError
from aero_viz.flight.rules import FlightRules
from aero_viz.flight.state_noise import StateNoise
from aero_viz.flight.vehicle_model import PLANNED, VehicleModel
from aero_viz.planners.registry import config_type
from aero_viz.recordings.choices import CloudFrame
from aero_viz.recordings.odometry_choice import OdometryChoice
from aero_viz.registry import is_place
from aero_viz.scenes.map_files import has_voxels
from aero_viz.sensors.models import LIDARS, LidarModel, admit_lidars, lidar_model

if TYPE_CHECKING:
    from aero_planner.missions import Mission
    from aero_viz.scenes.world import World

T = TypeVar("T")
Inline = Annotated[T, tyro.conf.arg(name="")]
"""A group of flags whose names have no prefix."""


def _admit_scene(name: str) -> str:
    if is_place(name):  # otherwise, nothing needs the scenes yet
        from aero_viz.scenes import SCENES

        SCENES.admit(name)
    return name


def _part(admit: Callable[[str], str], metavar: str) -> Any:
    """Return the annotation of a name that may be the place "module:attribute" of a part, which is then imported."""
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=metavar,
        instance_from_str=lambda values: admit(values[0]),
        is_instance=lambda value: isinstance(value, str),
        str_from_instance=lambda value: [value],
    )


WorldName = tyro.conf.Positional[Annotated[str, _part(_admit_scene, "WORLD")]]
"""A scene, the file of a world, or "module:function" of a scene."""
LogOrWorldName = tyro.conf.Positional[Annotated[str, _part(_admit_scene, "LOG|WORLD")]]
FileName = tyro.conf.Positional[Annotated[str, tyro.conf.arg(metavar="FILE")]]
OutputPath = tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="OUTPUT")]]
LidarName = Annotated[str, _part(admit_lidars, "{" + ",".join([*LIDARS.shipped, "MODULE:NAME"]) + "}[@YAW][+..]")]
"""A sensor of `LIDARS` or at "module:attribute", or several on one drone, see `lidar_model`."""
Point = tuple[float, float, float]
AERO_MPPI = PlannerConfig.planner
"""Name of the planner without --planner."""


def _optional(metavar: str) -> Any:
    """Return the annotation of a flag without a default value; its help text says what happens if it is absent."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="")


OptionalFileName = tyro.conf.Positional[Annotated[str | None, _optional("FILE")]]
OptionalFloat = Annotated[float | None, _optional("FLOAT")]
OptionalInt = Annotated[int | None, _optional("INT")]
OptionalBox = Annotated[tuple[float, float, float, float, float, float] | None, _optional("X Y Z X Y Z")]
OptionalPath = Annotated[Path | None, _optional("PATH")]
OptionalPoint = Annotated[Point | None, _optional("X Y Z")]
OptionalPose = Annotated[tuple[float, float, float, float, float, float] | None, _optional("X Y Z ROLL PITCH YAW")]
OptionalText = Annotated[str | None, _optional("STR")]
FoxgloveFlag = Annotated[tuple[int, ...] | None, _optional("[PORT]")]
"""None if the flag is absent, () if it has no port."""
PlannerName = Annotated[str, tyro.conf.arg(metavar="NAME|MODULE:CLASS|connect:ADDRESS")]
RayFlag = Annotated[tuple[str, ...] | None, _optional("[ADDRESS]")]
"""None if the flag is absent, () if it has no address of a cluster."""


def _flag_field(info: ParameterInfo) -> tuple[str, Any, Any]:
    """Return a parameter's flag as a field for `dataclasses.make_dataclass`. The field's default is None: not set."""
    kind: Any = Literal[info.choices] if info.choices else type(info.default)
    values = ("True", "False") if kind is bool else info.choices
    metavar = "{" + ",".join(values) + "}" if values else kind.__name__.upper()
    bounds = "" if not info.is_number else f" In [{info.low:g}, {info.high:g}]."
    unit = f" [{info.unit}]" if info.unit else ""
    argument = tyro.conf.arg(
        help=f"{info.help.rstrip('.')}{unit}.{bounds}",
        metavar=metavar,
        help_behavior_hint=f"(default: {_default(info)})",
    )
    return info.name, Annotated[kind | None, argument], None


def _default(info: ParameterInfo) -> str:
    """Return the default in the help of a flag."""
    if info.section == "drone" and info.name in PLANNED:
        return f"vehicle.{info.name}"
    if info.section == "lidar":
        values = {name: getattr(LIDARS[name], info.name) for name in LIDARS.shipped}
        if len(set(values.values())) > 1:
            return ", ".join(f"{value} for {name}" for name, value in values.items())
    return f"{info.default}"


def _flags_type(name: str, infos: Iterable[ParameterInfo], description: str) -> Any:
    """Return a dataclass with one field per parameter. A field is None where its flag was not set."""
    flags_type = dataclasses.make_dataclass(name, [_flag_field(info) for info in infos], frozen=True)
    flags_type.__doc__, flags_type.__module__ = description, __name__  # with the module it can be pickled
    return flags_type


def _planner_flags_type(config: type[DroneConfig]) -> Any:
    fields: list[tuple[str, Any, Any]] = []
    for name, parameters in config.sections().items():
        section = _flags_type(name.capitalize(), parameters.parameters(), f"Planner parameters: {name}.")
        fields.append((name, section, dataclasses.field(default_factory=section)))
    flags_type = dataclasses.make_dataclass("PlannerFlags", fields, frozen=True)
    flags_type.__doc__ = "Planner parameters. Each flag overrides the value of --config."
    return flags_type


def _set_values(flags: Any) -> dict[str, Any]:
    """Return the values of the flags that were set, by field name."""
    return {name: value for name, value in vars(flags).items() if value is not None}


PlannerFlags: Any = _planner_flags_type(PlannerConfig)
LidarFlags: Any = _flags_type(
    "LidarFlags", LidarModel.parameters(), "The LiDAR. Each flag overrides a value of the --lidar model."
)
DroneFlags: Any = _flags_type(
    "DroneFlags", VehicleModel.parameters(), "The simulated drone. The --vehicle flags are the planner's model of it."
)
NoiseFlags: Any = _flags_type("NoiseFlags", StateNoise.parameters(), (StateNoise.__doc__ or "").split("\n")[0])
RulesFlags: Any = _flags_type(
    "RulesFlags", FlightRules.parameters(), "When a flight ends and how often the planner plans."
)


def flight_rules(flags: Any) -> FlightRules:
    """Return the rules that `RulesFlags` describe.

    Raises:
        ValueError: a value is out of its bounds.
    """
    return FlightRules(**_set_values(flags))


@dataclasses.dataclass(frozen=True)
class ConfigFlags:
    """The planner and its configuration."""

    planner: PlannerName = AERO_MPPI
    """Planner: a name that `aero-viz doctor` lists, or module:Class of your own."""
    config: str = "default"
    """Preset (default, paper, ..) or YAML file."""
    values: Inline[PlannerFlags] = dataclasses.field(default_factory=PlannerFlags)

    def load(self, *, speed: float | None = None) -> DroneConfig:
        """Return the configuration that the flags describe.

        Args:
            speed: speed limit [m/s], which overrides the other flags; None keeps theirs.

        Raises:
            UserError: a name, file or value is wrong.
        """
        changes = {
            f"{section}.{name}": value
            for section, flags in vars(self.values).items()
            for name, value in _set_values(flags).items()
        }
        if speed is not None:
            changes["vehicle.speed_limit"] = speed
        try:
            return config_from_name(self.config, config_type(self.planner)).replace(changes)
        except (ValueError, OSError) as error:
            raise UserError(str(error)) from error

    def name_of(self, config: DroneConfig) -> str:
        """Return the name of a configuration that the flags describe: that of --config, and whether it was changed.

        A planner other than AERO-MPPI comes first.
        """
        name = self.config if self.planner == AERO_MPPI else f"{self.planner} {self.config}"
        return name if config == config_from_name(self.config, type(config)) else f"{name}, changed"


@functools.cache
def config_flags_type(planner: str) -> type[ConfigFlags]:
    """Return the flags of a planner: `ConfigFlags` with those of its own parameters.

    Raises:
        UserError: there is no such planner.
    """
    if planner == AERO_MPPI:
        return ConfigFlags
    values = _planner_flags_type(config_type(planner))
    fields = [("values", Inline[values], dataclasses.field(default_factory=values))]
    flags_type: Any = dataclasses.make_dataclass("ConfigFlags", fields, bases=(ConfigFlags,), frozen=True)
    flags_type.__doc__, flags_type.__module__ = ConfigFlags.__doc__, __name__
    return flags_type


@dataclasses.dataclass(frozen=True)
class FlightFlags:
    """The LiDAR, the simulated drone, the noise of the state estimate, and the rules of a flight."""

    sensor: Annotated[LidarFlags, tyro.conf.arg(name="lidar")] = dataclasses.field(default_factory=LidarFlags)
    drone: DroneFlags = dataclasses.field(default_factory=DroneFlags)
    noise: NoiseFlags = dataclasses.field(default_factory=NoiseFlags)
    rules: RulesFlags = dataclasses.field(default_factory=RulesFlags)

    @property
    def lidar_changes(self) -> dict[str, Any]:
        """The values of the LiDAR flags that were set, by parameter name."""
        return _set_values(self.sensor)

    @property
    def drone_changes(self) -> dict[str, Any]:
        """The values of the drone flags that were set, by parameter name."""
        return _set_values(self.drone)

    def state_noise(self) -> StateNoise | None:
        """Return the noise of the state estimate, or None where no noise flag was set; raises ValueError."""
        values = _set_values(self.noise)
        return StateNoise(**values) if values else None

    def options(self, config: DroneConfig, *, lidar: str) -> dict[str, Any]:
        """Return the arguments lidar, vehicle, rules and noise of a flight.

        Args:
            config: the planner's configuration, whose vehicle parameters are the defaults of the simulated drone.
            lidar: name of the LiDAR model.

        Raises:
            UserError: the LiDAR model does not exist.
            ValueError: a value is out of its bounds.
        """
        return {
            "lidar": dataclasses.replace(lidar_model(lidar), **self.lidar_changes),
            "vehicle": VehicleModel.from_config(config, **self.drone_changes),
            "rules": flight_rules(self.rules),
            "noise": self.state_noise(),
        }


@dataclasses.dataclass(frozen=True)
class RecordingFlags:
    """The recording."""

    points_topic: OptionalText = None
    """Topic of the point clouds; by default it is found by its type."""
    pose_topic: OptionalText = None
    """Topic of the poses; by default it is found by its type."""
    poses: OptionalPath = None
    """File of poses to use instead: TUM or KITTI text, or a ULog of PX4."""
    odometry: OdometryChoice = "none"
    """Estimate the motion from the sweeps: auto does so where no poses are recorded, by rko-lio with an IMU and by
    kiss-icp without; the named methods also replace recorded poses. The result is cached."""
    map: OptionalPath = None
    """Cloud of a known map (PCD, PLY, LAS, E57, NPY, text, a bag) in which each sweep is located, by multi-scale ICP
    from where the other poses, or a constant velocity, lead to. A sweep that does not fit is named."""
    map_start: OptionalPose = None
    """Position [m] and roll, pitch, yaw [deg] in the map at the first sweep, to a metre and 15 deg; by default those of
    the other poses, or the origin."""
    extrinsic: OptionalPose = None
    """Position [m] and roll, pitch, yaw [deg] of the sensor in the body's frame, instead of the recorded ones."""
    mask: OptionalBox = None
    """Leave out the points in a box in the body's frame, from its lower to its upper corner [m]."""
    columns: OptionalText = None
    """Rows of .bin files: the number of float32 columns, such as 5, or NumPy's types, such as 4f8 or 4f4,u2,f4; x, y, z
    come first. By default it is found in the numbers."""
    sensor: OptionalText = None
    """Sensor to play where several were recorded in one capture or on one topic; by default the one with the most
    points. `inspect` lists them."""
    cloud_frame: CloudFrame = "auto"
    """What the clouds move with: the body, or the world, as a map does; auto goes by the name of their frame."""

    @property
    def estimates_motion(self) -> bool:
        """True if opening the recording takes the time of an estimate."""
        return self.odometry != "none" or self.map is not None

    def options(self) -> dict[str, Any]:
        """Return the arguments of `open_recording`."""
        return dict(vars(self))


@dataclasses.dataclass(frozen=True)
class WorldFlags:
    """The world."""

    count: OptionalInt = None
    """Number of obstacles in a generated scene; by default the scene's own."""
    start: OptionalPoint = None
    """Start position x y z [m]; by default the world's own, on a map a free place."""
    goal: OptionalPoint = None
    """Goal position x y z [m]; by default the world's own, on a map a free place at most 45 m away."""
    waypoint: WaypointTexts = ()
    """Place to pass within a radius [m] (1), or to stop at, for hold [s]; the last is the goal. May be repeated. speed
    limits its leg [m/s]; it is given up after timeout [s] (10) without coming nearer. For x < 0 write
    --waypoint=-5,0,2."""
    mission: OptionalPath = None
    """YAML file of such waypoints, or of recorded paths to follow, instead."""
    voxel: OptionalFloat = None
    """Voxel size for a point-cloud map [m], about the spacing of its points; pixel size for an occupancy image."""

    def load(self, spec: str, *, seed: int) -> World:
        """Return the world with its start and goal.

        Args:
            spec: name of a scene, or path of a world (JSON, Gazebo), a point-cloud map, a mesh or an occupancy image.
            seed: seed of a scene.

        Raises:
            UserError: the world does not exist or is malformed, or a flag does not apply to it.
        """
        if self.voxel is not None and not (is_map(spec) or is_bag(spec)):
            raise UserError(
                f"--voxel applies to point-cloud maps and images only, and {spec} is neither; leave it out."
            )
        if self.voxel is not None and not (has_voxels(spec) or is_bag(spec)):
            raise UserError(f"{spec} has no voxels; leave --voxel out.")
        route = self.route()
        goal = self.goal if route is None else route.goal
        world = load_world(spec, seed=seed, count=self.count, start=self.start, goal=goal, voxel=self.voxel)
        return world if route is None else fly_through(world, route)

    def route(self) -> Mission | None:
        """Return the mission that the flags describe, None for a single goal; raises UserError."""
        return chosen_mission(self.waypoint, self.mission, goal=self.goal)
