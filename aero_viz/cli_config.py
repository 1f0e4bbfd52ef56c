"""Command line flags for every planner parameter, made from the configuration's own fields."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Any, Literal

import tyro

from aero_planner import PlannerConfig
from aero_planner.config import ParameterInfo, parameters
from aero_planner.config_file import config_from_name
from aero_viz.errors import UserError

__all__ = ["ConfigFlags", "Overrides"]


def _flag(info: ParameterInfo) -> tuple[str, Any, Any]:
    kind: Any = Literal[info.choices] if info.choices else type(info.default)
    bounds = "" if info.choices or kind is bool else f" In [{info.low:g}, {info.high:g}]."
    unit = f" [{info.unit}]" if info.unit else ""
    help = f"{info.help.rstrip('.')}{unit}.{bounds} Default {info.default}."
    return info.name, Annotated[kind | None, tyro.conf.arg(help=help)], None


def _make_overrides() -> type:
    sections: dict[str, list[tuple[str, Any, Any]]] = {}
    for info in parameters():
        sections.setdefault(info.section, []).append(_flag(info))
    fields: list[tuple[str, Any, Any]] = []
    for name, flags in sections.items():
        section = dataclasses.make_dataclass(name.capitalize(), flags, frozen=True)
        section.__doc__ = f"Planner parameters: {name}."
        fields.append((name, section, dataclasses.field(default_factory=section)))
    overrides = dataclasses.make_dataclass("Overrides", fields, frozen=True)
    overrides.__doc__ = "Planner parameters; each replaces the value of --config."
    return overrides


Overrides: Any = _make_overrides()
"""One field per parameter, None where the flag was not given."""


@dataclasses.dataclass(frozen=True)
class ConfigFlags:
    """The planner's configuration."""

    config: str = "default"
    """Preset (default, paper, ..) or YAML file."""
    planner: Annotated[Overrides, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Overrides)

    def load(self) -> PlannerConfig:
        """Return the configuration that the flags describe.

        Raises:
            UserError: a name, file or value is wrong.
        """
        changes = {
            f"{section}.{name}": value
            for section, values in dataclasses.asdict(self.planner).items()
            for name, value in values.items()
            if value is not None
        }
        try:
            return config_from_name(self.config).replace(changes)
        except (ValueError, OSError) as error:
            raise UserError(str(error)) from error
