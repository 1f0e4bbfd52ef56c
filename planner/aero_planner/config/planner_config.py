"""All parameters of the planner, in the sections of `config.sections`.

A *live* parameter is held in device memory and can change between two plans at no cost. A *structural* parameter sizes
buffers or selects kernels; changing it rebuilds the planner. Sliders, command line flags, YAML files and the
documentation are generated from the fields of the sections. Symbols are those of the paper.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

from aero_planner.config.parameter import ContradictionError, SectionedConfig, Value, did_you_mean
from aero_planner.config.presets import PRESETS
from aero_planner.config.sections.anchors import AnchorConfig
from aero_planner.config.sections.candidates import CandidateConfig
from aero_planner.config.sections.costs import CostConfig
from aero_planner.config.sections.escape import EscapeConfig
from aero_planner.config.sections.partition import LONGEST_MEMORY, PartitionConfig
from aero_planner.config.sections.sampling import SamplingConfig
from aero_planner.config.sections.vehicle import VehicleConfig

RENAMED: dict[str, str] = {"costs.way_ahead": "costs.waypoint_distance"}
"""New path of each renamed parameter by its old path, which files and flags accept for one release."""

REMOVED: dict[str, str] = {
    "costs.floor": "the ground height now comes from the world or the drone, and costs.use_ground enables it",
}
"""Reason for each removed parameter by its path, which files and flags ignore for one release."""


@dataclass(frozen=True)
class PlannerConfig(SectionedConfig):
    """All parameters of the planner.

    The default is the best configuration known; `preset("paper")` is the literal paper.

    Raises:
        ValueError: a parameter is out of bounds or contradicts another one; names parameter, value and range.
    """

    renamed: ClassVar[Mapping[str, str]] = RENAMED
    removed: ClassVar[Mapping[str, str]] = REMOVED

    vehicle: VehicleConfig = field(default_factory=VehicleConfig)
    partition: PartitionConfig = field(default_factory=PartitionConfig)
    anchors: AnchorConfig = field(default_factory=AnchorConfig)
    candidates: CandidateConfig = field(default_factory=CandidateConfig)
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    costs: CostConfig = field(default_factory=CostConfig)
    escape: EscapeConfig = field(default_factory=EscapeConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        for path, low, high in (
            ("vehicle.thrust", self.vehicle.thrust_min, self.vehicle.thrust_max),
            ("costs.distance", self.costs.distance_min, self.costs.distance_max),
            ("partition.range", self.partition.range_min, self.partition.range_max),
            ("partition.view", self.partition.view_min, self.partition.view_max),
            ("costs.height", self.costs.height_min, self.costs.height_max),
        ):
            if low >= high:
                message = f"{path}_min is {low}; it must be less than {path}_max, which is {high}."
                raise ContradictionError(message, f"{path}_min", f"{path}_max")

    @property
    def anchor_count(self) -> int:
        """Number of anchors, M_h M_v."""
        return self.anchors.columns * self.anchors.rows

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kind of each instance, length M: first the anchors, then the additional candidates."""
        additional = ("previous",) * self.candidates.previous + ("brake",) * self.candidates.brake
        return ("anchor",) * self.anchor_count + additional

    @property
    def horizon(self) -> float:
        """Length of the horizon, T = N dt [s]."""
        return self.sampling.steps * self.sampling.dt

    @property
    def farthest_range(self) -> float:
        """Range beyond which points are ignored, which grows with the speed limit [m]."""
        return max(self.partition.range_max, self.partition.range_time * self.vehicle.speed_limit)

    @property
    def memory(self) -> float:
        """Time for which a simulated flight remembers sweeps, which is longer at a low speed limit [s]."""
        flown = min(self.partition.memory_distance / self.vehicle.speed_limit, LONGEST_MEMORY)
        return max(self.partition.memory_time, flown)

    @property
    def forgets_wakes(self) -> bool:
        """True if points are left out that obstacles have left behind, see `kernels.wakes`."""
        return self.partition.predict and self.vehicle.speed_limit < self.partition.predict_wake_speed

    def structure(self) -> tuple[tuple[str, Value], ...]:
        """Return path and value of each structural parameter; configurations of equal structure can share buffers."""
        return tuple((info.path, self.get(info.path)) for info in self.parameters() if not info.live)

    @classmethod
    def presets(cls) -> dict[str, str]:
        """Return the description of each preset by name."""
        return {name: help for name, (help, _) in PRESETS.items()}

    @classmethod
    def preset(cls, name: str) -> PlannerConfig:
        """Return a preset by name.

        Raises:
            ValueError: there is no such preset; the message lists the presets.
        """
        if name not in PRESETS:
            raise ValueError(f"unknown preset {name!r}{did_you_mean(name, PRESETS)}; known: {', '.join(PRESETS)}.")
        return cls().replace(PRESETS[name][1])
