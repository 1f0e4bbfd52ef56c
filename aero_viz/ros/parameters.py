"""The parameters of a session as those of a node of ROS 2, from the one table that makes the sliders, too."""

from __future__ import annotations

from typing import Any

from aero_planner.config import DroneConfig, ParameterInfo
from aero_viz.ros.graph import Graph
from aero_viz.session.base import BaseSession

_PERIOD = 0.1
"""Time after which a change in the session is a change of the node's parameters, too [s]."""
_VIEW_ONLY = "This session can only be watched; its parameters are set on the drone."


class SessionParameters:
    """Declares every parameter of the session's planner, such as "costs.q_track", and keeps both sides equal.

    What another node sets goes through `SessionControls.configure`, and is refused with its reason. What changes in the
    session, by sliders, presets or undo, is set on the node. With another planner, its parameters are declared.

    Args:
        graph: node whose parameters others may set.
        session: the session.
    """

    def __init__(self, graph: Graph, session: BaseSession) -> None:
        from rclpy.clock import Clock
        from rclpy.clock_type import ClockType

        self._node, self._session = graph.node, session
        self._shown: DroneConfig | None = None
        self._is_own = False
        """True while the node's parameters are set from here."""
        self._show()
        self._node.add_on_set_parameters_callback(self._take)
        # All on the thread of the node, so that nothing is set by two threads at once.
        self._node.create_timer(_PERIOD, self._show, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _take(self, parameters: list[Any]) -> Any:
        """Configure the session as another node asks; return whether that was possible, and why not."""
        from rcl_interfaces.msg import SetParametersResult

        if self._is_own:
            return SetParametersResult(successful=True)
        known = {info.path for info in self._session.config.parameters()}
        changes = {parameter.name: parameter.value for parameter in parameters if parameter.name in known}
        if changes and self._session.controls is None:
            return SetParametersResult(successful=False, reason=_VIEW_ONLY)
        try:
            if changes and self._session.controls is not None:
                self._session.controls.configure(changes)
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _show(self) -> None:
        """Make the node's parameters those of the session."""
        from rclpy.parameter import Parameter

        config = self._session.config
        self._is_own = True
        try:
            if type(config) is not type(self._shown):
                self._declare(config)
            values = ((info.path, config.get(info.path)) for info in config.parameters())
            # An integer that was set for a float is equal, but of another type.
            changed = [
                Parameter(path, value=value)
                for path, value in values
                if (old := self._node.get_parameter(path).value) != value or type(old) is not type(value)
            ]
            self._shown = config
            if changed:
                self._node.set_parameters(changed)
        finally:
            self._is_own = False

    def _declare(self, config: DroneConfig) -> None:
        if self._shown is not None:
            for info in self._shown.parameters():
                self._node.undeclare_parameter(info.path)
        self._node.declare_parameters(
            "", [(info.path, config.get(info.path), _descriptor(info)) for info in config.parameters()]
        )


def _descriptor(info: ParameterInfo) -> Any:
    from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

    descriptor = ParameterDescriptor(
        name=info.path,
        description=f"{info.title}: {info.help}",
        additional_constraints=info.range,
        # Otherwise 8 for 8.0 would be refused, with the numbers of the types as the reason.
        dynamic_typing=True,
    )
    if isinstance(info.default, float):
        descriptor.floating_point_range = [FloatingPointRange(from_value=info.low, to_value=info.high)]
    elif info.is_number:
        descriptor.integer_range = [IntegerRange(from_value=int(info.low), to_value=int(info.high), step=1)]
    return descriptor
