"""Links that open the page with a source, a seed, a time and a configuration."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import parse_qsl, urlencode

from aero_planner import PlannerConfig
from aero_planner.config import DroneConfig, ParameterInfo, did_you_mean
from aero_viz.errors import UserError
from aero_viz.flight.conditions import OFFERED
from aero_viz.flight.flight_settings import FlightSettings
from aero_viz.flight.rules import FlightRules
from aero_viz.flight.state_noise import StateNoise
from aero_viz.flight.vehicle_model import VehicleModel
from aero_viz.planners.registry import name_of
from aero_viz.sensors.models import LIDARS, lidar_model
from aero_viz.session.source import Conditions, SourceInfo

MOST_ENTRIES = 500
"""Largest number of entries in the query of a link; there may be one for each parameter."""
_LIDAR = "mid360"
"""The LiDAR of `aero-viz demo` without flags."""


@dataclass(frozen=True)
class Opening:
    """Source that a page has opened: the arguments of its `Opener`."""

    spec: str
    """Name of a scene, or path of a file."""
    seed: int = 0
    conditions: Conditions | None = None
    """Conditions of a flight; None are those of the program's flags."""

    def command(self, source: SourceInfo, config: DroneConfig) -> str:
        """Return the command that shows the same flight or recording.

        Args:
            source: facts of the source that was opened.
            config: configuration of the planner, without the facts of the flight.
        """
        words = ["aero-viz", "demo" if source.closed_loop else "play", self.spec, "--seed", str(self.seed)]
        if source.closed_loop:
            count = None if self.conditions is None else self.conditions.count
            words += [] if count is None else ["--count", str(count)]
            words += _flight_flags(source, config)
        return shlex.join([*words, *_config_flags(config)])


@dataclass(frozen=True)
class Link:
    """Moment that a link opens again."""

    opening: Opening
    time: float = 0.0
    """Source time [s]."""
    config: Mapping[str, Any] = field(default_factory=dict)
    """Parameters that differ from the default, by path."""

    @classmethod
    def to_moment(cls, opening: Opening, time: float, config: DroneConfig) -> Link:
        """Return the link to a moment under a configuration."""
        changes = type(config)().differences(config)
        return cls(opening, time, {path: value for path, (_, value) in changes.items()})

    @property
    def query(self) -> str:
        """The link as the query of an address, such as "?source=forest&seed=3&time=4.2&costs.q_track=8.0"."""
        opening, conditions = self.opening, self.opening.conditions
        entries: dict[str, Any] = {"source": opening.spec, "seed": opening.seed, "time": f"{self.time:.3f}"}
        if conditions is not None:
            entries |= {} if conditions.count is None else {"count": conditions.count}
            entries |= {} if conditions.lidar is None else {"lidar": conditions.lidar}
            defaults = {info.path: info.default for info in OFFERED}
            entries |= {path: value for path, value in conditions.values.items() if value != defaults.get(path)}
        return "?" + urlencode({**entries, **self.config}, safe="/")

    @classmethod
    def parse(cls, query: str, kind: type[DroneConfig] = PlannerConfig) -> Link | None:
        """Return the link in the query of an address, for configurations of `kind`; None if there is none.

        Raises:
            ValueError: an entry is unknown or its value cannot be used; names it.
        """
        entries = dict(parse_qsl(query.removeprefix("?"), keep_blank_values=True, max_num_fields=MOST_ENTRIES))
        if "source" not in entries:
            return None
        spec, conditions = entries.pop("source"), {info.path: info for info in OFFERED}
        seed = _number(entries, "seed", 0)
        time = _number(entries, "time", 0.0)
        count = _number(entries, "count", 0) if "count" in entries else None
        lidar = entries.pop("lidar", None)
        parameters = {info.path: info for info in kind.parameters()}
        values, config = {}, {}
        for path, text in entries.items():
            if path in conditions:
                values[path] = conditions[path].check(_value(conditions[path], text))
            elif (current := kind.current_path(path, "The link: ")) in parameters:
                config[current] = _value(parameters[current], text)
            elif current is not None:  # not one that was removed
                hint = did_you_mean(path, [*conditions, *parameters])
                raise ValueError(
                    f"The link has an entry {path!r}, which this version does not know{hint}; "
                    f"{kind.listing} lists all parameters."
                )
        kind().replace(config)  # raises for a value out of its bounds
        has_conditions = bool(values) or count is not None or lidar is not None
        opening = Opening(spec, seed, Conditions(count, lidar, values) if has_conditions else None)
        return cls(opening, time, config)


def _flight_flags(source: SourceInfo, config: DroneConfig) -> list[str]:
    """Return the flags of the LiDAR, the drone, the noise and the rules that differ from the defaults of `demo`."""
    if "lidar" not in source.settings:  # a source of another program
        return []
    settings = FlightSettings.from_dict(source.settings)
    try:
        named = lidar_model(settings.lidar.name)
    except UserError:  # a model of another program
        named = LIDARS[_LIDAR]
    pairs: list[tuple[Any, Any]] = [
        (named, settings.lidar),
        (VehicleModel.from_config(config), settings.drone),
        (StateNoise(), settings.noise or StateNoise()),
        (FlightRules(), settings.rules),
    ]
    flags = [] if named.name == _LIDAR else ["--lidar", named.name]
    for default, actual in pairs:
        for info in actual.parameters():
            value = getattr(actual, info.name)
            flags += [] if value == getattr(default, info.name) else _flag(info.path, value)
    return flags


def _config_flags(config: DroneConfig) -> list[str]:
    """Return the flags of a configuration: the preset that it differs from least, and the differences."""
    differences = {name: config.preset(name).differences(config) for name in config.presets()}
    name = min(differences, key=lambda name: (len(differences[name]), name != "default"))
    flags = [] if config.planner == PlannerConfig.planner else ["--planner", name_of(config)]
    flags += [] if name == "default" else ["--config", name]
    return flags + [word for path, (_, value) in differences[name].items() for word in _flag(path, value)]


def _flag(path: str, value: Any) -> list[str]:
    return [f"--{path.replace('_', '-')}", str(value)]


def _number(entries: dict[str, str], name: str, default: Any) -> Any:
    text = entries.pop(name, None)
    try:
        number = default if text is None else type(default)(text)
    except ValueError as error:
        raise ValueError(f"The link has {name} = {text!r}; it must be a number.") from error
    if not (math.isfinite(number) and 0 <= number < 2**31):
        raise ValueError(f"The link has {name} = {text!r}; it must be a finite number that is not negative.")
    return number


def _value(info: ParameterInfo, text: str) -> Any:
    if isinstance(info.default, str):
        return text
    if isinstance(info.default, bool):
        if text not in ("True", "False"):
            raise ValueError(f"The link has {info.path} = {text!r}; it must be True or False.")
        return text == "True"
    try:
        return type(info.default)(text)
    except ValueError as error:
        raise ValueError(f"The link has {info.path} = {text!r}; it must be a number.") from error
