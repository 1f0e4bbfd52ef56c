"""Parameters of the planner, the base classes of all configurations, and configuration files."""

from __future__ import annotations

from aero_planner.config.drone_config import DroneConfig
from aero_planner.config.planner_config import PlannerConfig
from aero_planner.config.sections.anchors import AnchorConfig
from aero_planner.config.sections.candidates import CandidateConfig
from aero_planner.config.sections.costs import CostConfig
from aero_planner.config.sections.partition import PartitionConfig
from aero_planner.config.sections.sampling import SamplingConfig
from aero_planner.config.sections.vehicle import VehicleConfig
from aero_planner.parameters import ParameterInfo, ParameterSection, SectionedConfig, Value, did_you_mean

__all__ = [
    "AnchorConfig",
    "CandidateConfig",
    "CostConfig",
    "DroneConfig",
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
