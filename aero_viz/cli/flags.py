"""Command line flags made from the fields of the dataclasses that own the parameters: planner, drone, LiDAR, rules."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import tyro

from aero_planner import PlannerConfig
from aero_planner.config import ParameterInfo, parameters
from aero_planner.config.file import config_from_name
from aero_viz.catalog import is_map, load_world
from aero_viz.errors import UserError
from aero_viz.flight import FlightRules, StateNoise, VehicleModel
from aero_viz.flight.vehicle import PLANNED
from aero_viz.scenes import SCENES, World
from aero_viz.sensors import LidarModel, lidar_model
from aero_viz.session.ground import preset_above

__all__ = [
    "ConfigFlags",
    "FileName",
    "FlightFlags",
    "Inline",
    "OutputPath",
    "RulesFlags",
    "WorldFlags",
    "WorldName",
    "flight_rules",
]

T = TypeVar("T")
Inline = Annotated[T, tyro.conf.arg(name="")]
"""A group of flags whose names carry no prefix of the group's own."""
WorldName = tyro.conf.Positional[Annotated[str, tyro.conf.arg(metavar="WORLD")]]
FileName = tyro.conf.Positional[Annotated[str, tyro.conf.arg(metavar="FILE")]]
OutputPath = tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="OUTPUT")]]
Point = tuple[float, float, float]


def _flag(info: ParameterInfo) -> tuple[str, Any, Any]:
    kind: Any = Literal[info.choices] if info.choices else type(info.default)
    values = ("True", "False") if kind is bool else info.choices
    metavar = "{" + ",".join(values) + "}" if values else kind.__name__.upper()
    bounds = "" if values else f" In [{info.low:g}, {info.high:g}]."
    unit = f" [{info.unit}]" if info.unit else ""
    default = f"vehicle.{info.name}" if info.section == "drone" and info.name in PLANNED else f"{info.default}"
    described = tyro.conf.arg(
        help=f"{info.help.rstrip('.')}{unit}.{bounds}", metavar=metavar, help_behavior_hint=f"(default: {default})"
    )
    return info.name, Annotated[kind | None, described], None


def _flags(name: str, infos: Iterable[ParameterInfo], text: str) -> Any:
    """Return a dataclass with one field per parameter, None where the flag was not given."""
    made = dataclasses.make_dataclass(name, [_flag(info) for info in infos], frozen=True)
    made.__doc__ = text
    return made


def _given(flags: Any) -> dict[str, Any]:
    return {name: value for name, value in vars(flags).items() if value is not None}


def _planner_flags() -> Any:
    sections: dict[str, list[ParameterInfo]] = {}
    for info in parameters():
        sections.setdefault(info.section, []).append(info)
    fields: list[tuple[str, Any, Any]] = []
    for name, infos in sections.items():
        section = _flags(name.capitalize(), infos, f"Planner parameters: {name}.")
        fields.append((name, section, dataclasses.field(default_factory=section)))
    made = dataclasses.make_dataclass("PlannerFlags", fields, frozen=True)
    made.__doc__ = "Planner parameters; each replaces the value of --config."
    return made


PlannerFlags: Any = _planner_flags()
LidarFlags: Any = _flags("LidarFlags", LidarModel.parameters(), "The LiDAR; each replaces --lidar's own.")
DroneFlags: Any = _flags(
    "DroneFlags", VehicleModel.parameters(), "The simulated drone; --vehicle is what the planner assumes."
)
NoiseFlags: Any = _flags("NoiseFlags", StateNoise.parameters(), (StateNoise.__doc__ or "").split("\n")[0])
RulesFlags: Any = _flags("RulesFlags", FlightRules.parameters(), "When a flight ends, and how often is planned.")


def flight_rules(flags: Any) -> FlightRules:
    """Return the rules that `RulesFlags` describe; raises ValueError."""
    return FlightRules(**_given(flags))


@dataclasses.dataclass(frozen=True)
class ConfigFlags:
    """The planner's configuration."""

    config: str = "default"
    """Preset (default, paper, ..) or YAML file."""
    planner: Inline[PlannerFlags] = dataclasses.field(default_factory=PlannerFlags)

    def load(self, ground: float | None = None) -> PlannerConfig:
        """Return the configuration that the flags describe.

        Args:
            ground: height of the flat ground that the drone took off from [m]. Presets but the paper's are told of it
                by costs.floor, unless that is given.

        Raises:
            UserError: a name, file or value is wrong.
        """
        changes = {
            f"{section}.{name}": value
            for section, flags in vars(self.planner).items()
            for name, value in _given(flags).items()
        }
        try:
            is_preset = self.config in PlannerConfig.presets()
            config = preset_above(self.config, ground) if is_preset else config_from_name(self.config)
            return config.replace(changes)
        except (ValueError, OSError) as error:
            raise UserError(str(error)) from error


@dataclasses.dataclass(frozen=True)
class FlightFlags:
    """What is flown, with what sensor, and by which rules."""

    sensor: Annotated[LidarFlags, tyro.conf.arg(name="lidar")] = dataclasses.field(default_factory=LidarFlags)
    drone: DroneFlags = dataclasses.field(default_factory=DroneFlags)
    noise: NoiseFlags = dataclasses.field(default_factory=NoiseFlags)
    rules: RulesFlags = dataclasses.field(default_factory=RulesFlags)

    def lidar(self, name: str) -> LidarModel:
        """Return the LiDAR of that name, with what the flags change of it; raises UserError or ValueError."""
        return dataclasses.replace(lidar_model(name), **self.lidar_changes)

    @property
    def lidar_changes(self) -> dict[str, Any]:
        """What the flags change of the LiDAR."""
        return _given(self.sensor)

    @property
    def drone_changes(self) -> dict[str, Any]:
        """What the flags change of the drone that the planner assumes."""
        return _given(self.drone)

    def flight_rules(self) -> FlightRules:
        """Return the rules; raises ValueError."""
        return flight_rules(self.rules)

    def state_noise(self) -> StateNoise | None:
        """Return the noise of the state estimate, None without a flag; raises ValueError."""
        return StateNoise(**given) if (given := _given(self.noise)) else None

    def options(self, config: PlannerConfig, *, lidar: str) -> dict[str, Any]:
        """Return the options lidar, vehicle, rules and noise of a flight.

        Raises:
            UserError: there is no such LiDAR.
            ValueError: a value is out of its bounds.
        """
        return {
            "lidar": self.lidar(lidar),
            "vehicle": VehicleModel.from_config(config, **self.drone_changes),
            "rules": self.flight_rules(),
            "noise": self.state_noise(),
        }


@dataclasses.dataclass(frozen=True)
class WorldFlags:
    """The world."""

    count: int | None = None
    """Number of obstacles of a scene; its own when left out."""
    start: Point | None = None
    """First position x y z [m]; the world's own when left out, on a map of points a free place."""
    goal: Point | None = None
    """Goal x y z [m]; the world's own when left out, on a map of points a free place up to 45 m away."""
    voxel: float | None = None
    """Edge of the voxels that a map of points is made of [m], about the spacing of its points."""

    def ground(self, spec: str, *, seed: int) -> float | None:
        """Return the height of a world's flat ground [m]; None where it has none, as a map of points or a recording.

        Raises:
            UserError: as `load`.
        """
        return self.load(spec, seed=seed).ground_height if spec in SCENES or spec.endswith(".json") else None

    def load(self, spec: str, *, seed: int) -> World:
        """Return the world of a scene's name, a JSON file or a map of points, with its start and goal.

        Raises:
            UserError: there is no such world, it is malformed, or a flag does not belong to it.
        """
        if is_map(spec) and self.count is None:
            voxel = {} if self.voxel is None else {"voxel": self.voxel}
            return World.from_map(spec, start=self.start, goal=self.goal, **voxel)
        if self.voxel is not None and not is_map(spec):
            raise UserError(f"--voxel belongs to a map of points, and {spec} is none; leave it out.")
        world = load_world(spec, seed=seed, count=self.count)
        ends = {"start": self.start, "goal": self.goal}
        try:
            return dataclasses.replace(world, **{name: end for name, end in ends.items() if end is not None})
        except ValueError as error:
            raise UserError(f"{spec}: {error}") from error
