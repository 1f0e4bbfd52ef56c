"""One MPPI toward the goal: the paper's ablation, AERO-MPPI without its ensemble."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import ClassVar

from aero_planner.config import AnchorConfig, CandidateConfig, PlannerConfig
from aero_viz.planners.aero_mppi import AeroMppi


@dataclass(frozen=True)
class SingleMppiConfig(PlannerConfig):
    """The parameters of AERO-MPPI with one instance, whose guide leads toward the goal."""

    planner: ClassVar[str] = "single_mppi"

    anchors: AnchorConfig = field(default_factory=functools.partial(AnchorConfig, columns=1, rows=1))
    candidates: CandidateConfig = field(default_factory=functools.partial(CandidateConfig, previous=False))


class SingleMppi(AeroMppi):
    """The kernels of AERO-MPPI with a single instance."""

    Config = SingleMppiConfig
