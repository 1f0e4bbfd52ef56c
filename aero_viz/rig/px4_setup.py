"""Sets PX4's parameters before a flight on the rig, by the node's own preflight code."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping

from aero_planner.config import VehicleConfig
from aero_planner.onboard.connections import thrust_model
from aero_planner.onboard.mavlink import MavlinkLink
from aero_planner.onboard.px4_parameters import (
    ParameterChange,
    find_changes,
    parameter_names,
    read_parameters,
    write_parameters,
)
from aero_planner.onboard.settings import OnboardConfig
from aero_viz.errors import UserError
from aero_viz.rig.px4_process import HOST, Px4Process

_START_TIME = 90.0  # [s] of simulated time for PX4 to start and to find its position
_POLL_PERIOD = 0.02  # [s]


def set_parameters(
    px4: Px4Process, onboard: OnboardConfig, vehicle: VehicleConfig, values: Mapping[str, float]
) -> list[ParameterChange]:
    """Set the parameters that preflight requires, and others; return the changes.

    Args:
        px4: a PX4 that is starting.
        onboard, vehicle: configuration of the flight.
        values: other parameters by name; they take precedence.

    Raises:
        UserError: PX4 has ended or does not start, or a parameter does not exist or was not accepted.
    """
    # Every time-out counts in simulated time, in which PX4 sends its heartbeats.
    address, thrust, clock = f"udpin:{HOST}:{px4.companion_remote}", thrust_model(onboard, vehicle), px4.clock
    link = MavlinkLink(address, thrust, system=px4.system, clock=clock)
    with contextlib.closing(link):
        _wait(px4, link, lambda: link.state is not None, "does not report a position")
        # A PX4 that is still starting answers late.
        _wait(
            px4,
            link,
            lambda: bool(read_parameters(link, ["COM_OF_LOSS_T"], clock=clock)),
            "does not report its parameters",
        )
        present = read_parameters(link, {*parameter_names(onboard), *values}, clock=clock)
        if unknown := sorted(set(values) - set(present)):
            raise UserError(f"PX4 has no parameter {', '.join(unknown)}.")
        changes = [change for change in find_changes(present, onboard) if change.name not in values]
        changes += [ParameterChange(name, value, present[name]) for name, value in values.items()]
        result = write_parameters(link, changes, clock=clock)
        if result.unconfirmed:
            reason = f": {result.refusal}" if result.refusal else ""
            raise px4.failure(f"PX4 did not accept {', '.join(result.unconfirmed)}{reason}")
    return changes


def _wait(px4: Px4Process, link: MavlinkLink, condition: Callable[[], bool], what: str) -> None:
    end = px4.clock() + _START_TIME
    while not condition():
        px4.check()
        if px4.clock() > end:
            raise px4.failure(f"PX4 {what} within {_START_TIME:g} s")
        time.sleep(_POLL_PERIOD)
        link.poll()
