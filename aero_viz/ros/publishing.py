"""A sink of frames that publishes every flight and every recording in ROS 2: `--ros-out`."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from aero_planner import VehicleState
from aero_planner.onboard.ros_definitions import CLOUD, MARKERS, PATH
from aero_planner.onboard.ros_messages import Encoded, best_path, guide_lines
from aero_viz.errors import UserError
from aero_viz.logs.flight_messages import FlightMessages
from aero_viz.ros import messages
from aero_viz.ros.graph import Graph
from aero_viz.ros.parameters import offer_parameters
from aero_viz.session.base import BaseSession
from aero_viz.session.frame import Frame

if TYPE_CHECKING:
    from aero_viz.flight.single import FlightRecorders

_CLOSE_TIMEOUT = 2.0  # [s] for the last messages
_GLOBAL = ("/tf", "/diagnostics")
"""Topics that everyone shares; all others are in the namespace /aero_viz, apart from those of a drone that is shown."""
_LATCHED = ("/goal",)
"""Topics whose last message also reaches who comes later."""
_ON_DEMAND: dict[str, tuple[str, Callable[[Frame, int], Any]]] = {
    "/plan/best": (PATH, lambda frame, stamp: best_path(frame.plan, stamp)),
    "/plan/guides": (MARKERS, lambda frame, stamp: guide_lines(frame.plan, stamp)),
    "/plan/candidates": (MARKERS, lambda frame, stamp: messages.candidate_markers(frame.plan, stamp)),
    "/plan/cells": (CLOUD, messages.cell_cloud),
    "/plan/filtered": (CLOUD, messages.filtered_cloud),
    "/diagnostics": ("diagnostic_msgs/msg/DiagnosticArray", messages.diagnostics),
    "/command/velocity": ("geometry_msgs/msg/TwistStamped", messages.velocity_command),
    "/command/acceleration": ("geometry_msgs/msg/AccelStamped", messages.acceleration_command),
}
"""Type of each topic of the plan, and what makes its message where somebody subscribes."""


class FramePublisher:
    """Publishes frames: pose, sweeps and goal as in the flight log, where their types are installed, and the plan.

    Stamps are the wall time at which the publisher began plus the time of the source, and never go back.

    Args:
        graph: the node that publishes.
    """

    def __init__(self, graph: Graph) -> None:
        self._graph = graph
        self._messages = FlightMessages()
        self._publishers: dict[str, Any] = {}
        for topic, (kind, _) in _ON_DEMAND.items():
            self._publisher(topic, kind)

    def write(self, frame: Frame) -> None:
        """Publish a frame."""
        # A drone that is shown live has transforms of its own.
        is_live = frame.source.times is None and not frame.source.closed_loop
        for encoded, _ in self._messages.encode_inputs(frame):
            if not (is_live and encoded.topic == "/tf"):
                self._send(encoded)
        for topic, (_, make) in _ON_DEMAND.items():
            publisher = self._publishers[topic]
            if publisher is not None and publisher.get_subscription_count():
                message = make(frame, self._messages.stamp)
                if message is not None:
                    publisher.publish(message.data if isinstance(message, Encoded) else message)

    def write_pose(self, time: float, state: VehicleState) -> None:
        """Publish the pose of the drone between two frames; see `FlightMessages.encode_pose`."""
        for encoded, _ in self._messages.encode_pose(time, state):
            self._send(encoded)

    def is_watched(self) -> bool:
        """Return True if somebody subscribes to a topic."""
        return any(publisher.get_subscription_count() for publisher in tuple(self._publishers.values()) if publisher)

    def close(self) -> None:
        """Wait until all messages have arrived, for two seconds at most."""
        from rclpy.duration import Duration

        for publisher in filter(None, self._publishers.values()):
            publisher.wait_for_all_acked(Duration(seconds=_CLOSE_TIMEOUT / len(self._publishers)))

    def _send(self, encoded: Encoded) -> None:
        if (publisher := self._publisher(encoded.topic, encoded.kind)) is not None:
            publisher.publish(encoded.data)

    def _publisher(self, topic: str, kind: str) -> Any:
        """Return the publisher of a topic; None where its type is not installed, such as tf2_msgs beside the wheels."""
        if topic not in self._publishers:
            name = topic if topic in _GLOBAL else f"/aero_viz{topic}"
            try:
                self._publishers[topic] = self._graph.publisher(name, kind, latched=topic in _LATCHED)
            except UserError:
                self._publishers[topic] = None
        return self._publishers[topic]


@contextlib.contextmanager
def publish_session(session: BaseSession) -> Iterator[FramePublisher]:
    """Publish every frame of a session while the context is open, with its parameters. The engine never waits for it.

    Raises:
        UserError: there is no ROS 2, or it cannot start.
    """
    with Graph(parameters=True) as graph:
        offer_parameters(graph, session)
        publisher = FramePublisher(graph)
        with contextlib.closing(publisher), session.every_frame(publisher.write, name="ros"):
            yield publisher


@contextlib.contextmanager
def ros_recorder(*, log: contextlib.AbstractContextManager[Any] | None = None) -> Iterator[FlightRecorders]:
    """Open a recorder of `aero_viz.flight.fly` that publishes the flight.

    Args:
        log: another recorder, which gets the flight, too; None without.

    Raises:
        UserError: there is no ROS 2, or it cannot start.
    """
    from aero_viz.flight.single import FlightRecorders  # loads the simulator, which a viewer of a drone does not need

    with contextlib.ExitStack() as stack:
        publisher = stack.enter_context(contextlib.closing(FramePublisher(stack.enter_context(Graph()))))
        files = [] if log is None else [stack.enter_context(log)]
        yield FlightRecorders(publisher, *files)
