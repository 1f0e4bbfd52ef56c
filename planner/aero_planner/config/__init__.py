"""Every parameter of the planner, and the file format that stores a configuration."""

from __future__ import annotations

from aero_planner.config.parameter import ParameterInfo, Value, did_you_mean
from aero_planner.config.planner_config import (
    SECTIONS,
    AnchorConfig,
    CandidateConfig,
    CostConfig,
    PartitionConfig,
    PlannerConfig,
    SamplingConfig,
    VehicleConfig,
    check_section,
    find_parameter,
    parameters,
)

__all__ = [
    "SECTIONS",
    "AnchorConfig",
    "CandidateConfig",
    "CostConfig",
    "ParameterInfo",
    "PartitionConfig",
    "PlannerConfig",
    "SamplingConfig",
    "Value",
    "VehicleConfig",
    "check_section",
    "did_you_mean",
    "find_parameter",
    "parameters",
]
