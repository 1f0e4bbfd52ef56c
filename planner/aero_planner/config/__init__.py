"""Parameters of the planner, the base classes of all configurations, and configuration files."""

from __future__ import annotations

from aero_planner.config.parameter import ParameterInfo, ParameterSection, SectionedConfig, Value, did_you_mean
from aero_planner.config.planner_config import (
    AnchorConfig,
    CandidateConfig,
    CostConfig,
    PartitionConfig,
    PlannerConfig,
    SamplingConfig,
    VehicleConfig,
)

__all__ = [
    "AnchorConfig",
    "CandidateConfig",
    "CostConfig",
    "ParameterInfo",
    "ParameterSection",
    "PartitionConfig",
    "PlannerConfig",
    "SamplingConfig",
    "SectionedConfig",
    "Value",
    "VehicleConfig",
    "did_you_mean",
]
