"""All parameters of the planner, in the sections of `config.sections`.

A *live* parameter is held in device memory and can change between two plans at no cost. A *structural* parameter sizes
buffers or selects kernels; changing it rebuilds the planner. Sliders, command line flags, YAML files and the
documentation are generated from the fields of the sections. Symbols are those of the paper.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field
from typing import Any, ClassVar

from aero_planner.config.drone_config import SHORTEST_MEMORY, DroneConfig
from aero_planner.config.old_names import CHANGED, REMOVED, RENAMED
from aero_planner.config.presets import PRESETS
from aero_planner.config.sections.anchors import AnchorConfig
from aero_planner.config.sections.candidates import CandidateConfig
from aero_planner.config.sections.costs import CostConfig
from aero_planner.config.sections.partition import PartitionConfig
from aero_planner.config.sections.sampling import SamplingConfig
from aero_planner.config.sections.stages import StageConfig
from aero_planner.parameters import Value, log_warning, with_sections
from aero_planner.registry import added_sections, names

COARSE_ROWS, COARSE_COLUMNS = 10, 20
"""Coarse cells from straight down to straight up and around the horizon, each 18 deg wide, as in the paper."""


@with_sections(added_sections())
class PlannerConfig(DroneConfig):
    """All parameters of the planner.

    The default is the best configuration known; `preset("paper")` is the literal paper.

    Raises:
        ValueError: a parameter is out of bounds or contradicts another one; names parameter, value and range.
    """

    planner: ClassVar[str] = "aero_mppi"
    renamed: ClassVar[Mapping[str, str]] = RENAMED
    changed: ClassVar[Mapping[str, str]] = CHANGED
    removed: ClassVar[Mapping[str, str]] = REMOVED

    partition: PartitionConfig = field(default_factory=PartitionConfig)
    anchors: AnchorConfig = field(default_factory=AnchorConfig)
    candidates: CandidateConfig = field(default_factory=CandidateConfig)
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    costs: CostConfig = field(default_factory=CostConfig)
    stages: StageConfig = field(default_factory=StageConfig)

    def replace(self, changes: Mapping[str, Value] | None = None, /, **sections: Any) -> PlannerConfig:
        """Return a copy with `changes`, see the base class; logs a notice of those that an inactive stage ignores."""
        config = super().replace(changes, **sections)
        inactive = set(names("stages")) - set(config.stages.names)
        for path in changes or ():
            current = self.renamed.get(path, path)
            section = current.partition(".")[0]
            if section in inactive and current not in self.removed and config.get(current) != self.get(current):
                log_warning("%s has no effect: stages.active does not list %s.", current, section)
        return config

    @property
    def anchor_count(self) -> int:
        """Number of anchors, M_h M_v."""
        return self.anchors.columns * self.anchors.rows

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kind of each instance, length M: first the anchors, then the additional candidates."""
        return ("anchor",) * self.anchor_count + ("previous",) * self.candidates.previous

    @property
    def previous_index(self) -> int:
        """Index of the instance that continues the previous plan; -1 if there is none."""
        return self.anchor_count if self.candidates.previous else -1

    @property
    def horizon(self) -> float:
        """Length of the horizon, T = N dt [s]."""
        return self.sampling.steps * self.sampling.dt

    @property
    def lookahead(self) -> float:
        """Longest look-ahead distance, which grows with the speed limit [m]."""
        return max(self.anchors.lookahead, self.anchors.lookahead_time * self.vehicle.speed_limit)

    @property
    def farthest_range(self) -> float:
        """Range beyond which points are ignored, which grows with the speed limit as the look-ahead does [m]."""
        return max(self.partition.range_max, 2.0 * self.anchors.lookahead_time * self.vehicle.speed_limit)

    @property
    def fine_shape(self) -> tuple[int, int]:
        """Number of rows and columns of fine cells."""
        return COARSE_ROWS * self.partition.fine_cells, COARSE_COLUMNS * self.partition.fine_cells

    @property
    def control_step(self) -> float:
        return self.sampling.dt

    @property
    def prefers_safe(self) -> bool:
        return self.candidates.prefer_safe

    @property
    def stage_sections(self) -> list[Any]:
        """The sections of the active stages that have parameters."""
        return [getattr(self, name) for name in self.stages.names if name in self.sections()]

    @property
    def sweep_memory(self) -> float:
        asked = [section.sweep_memory(self.vehicle.speed_limit) for section in self.stage_sections]
        return max((time for time in asked if time is not None), default=SHORTEST_MEMORY)

    @classmethod
    def preset_changes(cls) -> dict[str, tuple[str, dict[str, Value]]]:
        return PRESETS
