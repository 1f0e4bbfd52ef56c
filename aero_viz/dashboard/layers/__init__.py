"""Layers of the scene, in the order of the page. A new layer needs its module and an entry in the list."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from aero_viz.dashboard.layers.alternative import AlternativeLayer
from aero_viz.dashboard.layers.anchors import AnchorLayer, GuideLayer
from aero_viz.dashboard.layers.base import (
    Bar,
    BarChart,
    Change,
    ColorKey,
    ColorScale,
    Layer,
    Option,
    apply,
    legend_entries,
)
from aero_viz.dashboard.layers.cells import CoarseCellLayer, FineCellLayer, UnseenCellLayer
from aero_viz.dashboard.layers.cloud import CloudLayer
from aero_viz.dashboard.layers.drone import DroneLayer, GhostLayer, TrailLayer
from aero_viz.dashboard.layers.goal import GoalLayer
from aero_viz.dashboard.layers.mission import MissionLayer
from aero_viz.dashboard.layers.motion import MotionLayer
from aero_viz.dashboard.layers.rollouts import RolloutLayer
from aero_viz.dashboard.layers.samples import SampleLayer
from aero_viz.dashboard.layers.scenery import GroundLayer, ObstacleLayer, RecordedPathLayer, RecordedPlanLayer
from aero_viz.dashboard.layers.selection import SelectionLayer
from aero_viz.dashboard.layers.sight import OccludedSpaceLayer
from aero_viz.errors import UserError
from aero_viz.registry import Registry

__all__ = [
    "LAYERS",
    "Bar",
    "BarChart",
    "Change",
    "ColorKey",
    "ColorScale",
    "Layer",
    "Option",
    "apply",
    "known_names",
    "legend_entries",
]

_SHIPPED: tuple[type[Layer], ...] = (
    RolloutLayer,
    SelectionLayer,
    SampleLayer,
    GuideLayer,
    AnchorLayer,
    CloudLayer,
    FineCellLayer,
    UnseenCellLayer,
    OccludedSpaceLayer,
    CoarseCellLayer,
    MotionLayer,
    DroneLayer,
    TrailLayer,
    GhostLayer,
    AlternativeLayer,
    RecordedPathLayer,
    RecordedPlanLayer,
    GoalLayer,
    MissionLayer,
    ObstacleLayer,
    GroundLayer,
)


def _accept(name: str, found: Any) -> type[Layer]:
    if not (isinstance(found, type) and issubclass(found, Layer)) or getattr(found, "name", None) != name:
        raise UserError(
            f"{name} is not a layer of that name; give a class derived from aero_viz.dashboard.layers.Layer, whose "
            f"name is {name!r}."
        )
    return found


LAYERS: Registry[type[Layer]] = Registry("layer", "aero_viz.layers", {kind.name: kind for kind in _SHIPPED}, _accept)
"""All layers by name, in the order of the page."""
_RENAMED = {"hidden_space": "occluded_space"}
"""Current name of each renamed layer, whose old name is accepted for one release."""


def known_names(names: Sequence[str], layers: Mapping[str, Layer]) -> list[str]:
    """Return the current names of layers.

    Raises:
        UserError: there is no such layer; lists them.
    """
    current = [_RENAMED.get(name, name) for name in names]
    for name in current:
        if name not in layers:
            raise UserError(f"There is no layer {name!r}; the layers are {', '.join(layers)}.")
    return current
