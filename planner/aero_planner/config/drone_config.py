"""Base of the configuration of every planner for a drone."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar, TypeVar

from aero_planner.config.sections.vehicle import VehicleConfig
from aero_planner.parameters import SectionedConfig, Value, did_you_mean

Config = TypeVar("Config", bound="DroneConfig")
SHORTEST_MEMORY = 1.0
"""Time for which sweeps are remembered at least [s]: ten sweeps, as in the paper."""


@dataclass(frozen=True)
class DroneConfig(SectionedConfig):
    """The drone, and in derived classes the sections of a planner.

    Sliders, flags and files derive from the parameters of the sections. A parameter that is named like a fact of the
    flight, such as `height_max`, takes its value where it has its default.
    """

    planner: ClassVar[str] = ""
    """Planner that is configured: its registered name, or "module:Class"."""

    vehicle: VehicleConfig = field(default_factory=VehicleConfig)

    @property
    def control_step(self) -> float:
        """Time step of the controls in a plan that does not give its own [s]."""
        return 0.05

    @property
    def prefers_safe(self) -> bool:
        """True if safe candidates come first; false if only the one with the lowest cost is considered."""
        return True

    @property
    def sweep_memory(self) -> float:
        """Time for which sweeps are remembered [s]."""
        return SHORTEST_MEMORY

    def structure(self) -> tuple[tuple[str, Value], ...]:
        """Return path and value of each structural parameter; configurations of equal structure can share buffers."""
        return tuple((info.path, self.get(info.path)) for info in self.parameters() if not info.live)

    @classmethod
    def preset_changes(cls) -> dict[str, tuple[str, dict[str, Value]]]:
        """Return the description and the changes of each preset by name; "default" is the first."""
        return {"default": ("The default configuration.", {})}

    @classmethod
    def presets(cls) -> dict[str, str]:
        """Return the description of each preset by name."""
        return {name: help for name, (help, _) in cls.preset_changes().items()}

    @classmethod
    def preset(cls: type[Config], name: str) -> Config:
        """Return a preset by name.

        Raises:
            ValueError: there is no such preset; the message lists the presets.
        """
        known: dict[str, tuple[str, Any]] = cls.preset_changes()
        if name not in known:
            raise ValueError(f"unknown preset {name!r}{did_you_mean(name, known)}; known: {', '.join(known)}.")
        return cls().replace(known[name][1])

    @property
    def preset_name(self) -> str:
        """Name of the preset that this configuration equals, "custom" if there is none."""
        return next((name for name in self.presets() if self.preset(name) == self), "custom")
