"""The parameters of a session as those of a node of ROS 2, from the one table that makes the sliders, too."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from aero_planner.config import ParameterInfo, Value
from aero_planner.onboard.ros import NodeParameters
from aero_viz.ros.graph import Graph
from aero_viz.session.base import BaseSession


def offer_parameters(graph: Graph, session: BaseSession) -> None:
    """Declare every parameter of the session's planner on a node, and keep both sides equal.

    What another node sets goes through `SessionControls.configure`, and is refused with its reason. What changes in the
    session, by sliders, presets or undo, is set on the node. With another planner, its parameters are declared.

    Args:
        graph: node whose parameters others may set.
        session: the session.
    """

    def current() -> tuple[Sequence[ParameterInfo], Mapping[str, Value]]:
        config = session.config
        infos = config.parameters()
        return infos, {info.path: config.get(info.path) for info in infos}

    def ask(changes: Mapping[str, Any]) -> None:
        if session.controls is None:
            raise ValueError("This session can only be watched; its parameters are set on the drone.")
        session.controls.configure(changes)

    NodeParameters(graph.node, current, ask)
