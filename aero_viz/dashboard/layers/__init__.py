"""What can be drawn, one module for each kind; in the order of the page."""

from __future__ import annotations

from aero_viz.dashboard.layers.anchors import AnchorLayer, GuideLayer
from aero_viz.dashboard.layers.base import Change, Layer, apply
from aero_viz.dashboard.layers.cells import CoarseCellLayer, FineCellLayer
from aero_viz.dashboard.layers.cloud import CloudLayer
from aero_viz.dashboard.layers.drone import DroneLayer, TrailLayer
from aero_viz.dashboard.layers.goal import GoalLayer
from aero_viz.dashboard.layers.rollouts import RolloutLayer
from aero_viz.dashboard.layers.samples import SampleLayer
from aero_viz.dashboard.layers.scenery import GroundLayer, ObstacleLayer, RecordedPathLayer

__all__ = ["LAYERS", "Change", "Layer", "apply"]

LAYERS: tuple[type[Layer], ...] = (
    RolloutLayer,
    SampleLayer,
    GuideLayer,
    AnchorLayer,
    CloudLayer,
    FineCellLayer,
    CoarseCellLayer,
    DroneLayer,
    TrailLayer,
    RecordedPathLayer,
    GoalLayer,
    ObstacleLayer,
    GroundLayer,
)
