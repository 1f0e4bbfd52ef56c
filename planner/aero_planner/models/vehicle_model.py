"""The interface of a vehicle model: everything that the planner knows of the vehicle."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import warp as wp

from aero_planner.parameters import ParameterSection


@wp.func
def no_control(c: Any) -> wp.vec4:
    """Return zeros: the control at rest of a vehicle that stands."""
    return wp.vec4(0.0, 0.0, 0.0, 0.0)


@wp.func
def follow_at_once(u: wp.vec4, acting: wp.vec4, time: float, c: Any) -> wp.vec4:
    """Return u: the response of a vehicle without lag."""
    return u


@dataclass(frozen=True, eq=False)
class VehicleModel:
    """A vehicle whose state is position p, velocity v and attitude q, and whose control is four numbers.

    The *acting* control is the one in effect, which may follow the commands with a lag; it belongs to the state. Every
    function is a `@wp.func`. p and v are vec3 [m, m/s] in the world frame, q is a unit quaternion vec4 (w, x, y, z;
    body to world), controls are vec4, c holds the live parameters. Where a signature says K, it is the model's own
    struct of constants. In a model from outside the package, c is annotated with `typing.Any`.

    Args:
        name: name of the model, a value of `vehicle.model`.
        label: for people.
        controls: name and unit of each of the four numbers of a control.
        clamp: (u, c) -> u within its bounds.
        noise: (c) -> standard deviations of the sampled noise, vec4.
        constants: (disturbance, drag, dt, c) -> K: what is constant over all steps of dt [s]; the disturbance is an
            acceleration [m/s^2], vec3, the drag a deceleration per velocity [1/s].
        step: (p, v, q, acting, u, k) -> p, v, q, acting after one step.
        acceleration: (v, q, acting, k) -> acceleration [m/s^2], vec3, world frame.
        follow: (p, v, q, acting, guide, time, yaw_rate, k, c) -> the control with which to follow a guide, a `Quintic`,
            in the step from a time of it on [s], while turning at a yaw rate [rad/s].
        hover: (c) -> the control at which the vehicle at rest stays at rest; by default zeros.
        respond: (u, acting, time, c) -> acting control after u was commanded for a time [s]; by default u.
        parameters: section of the model's own parameters; None if it has none.
    """

    name: str
    label: str
    controls: tuple[tuple[str, str], ...]
    clamp: Callable[..., Any]
    noise: Callable[..., Any]
    constants: Callable[..., Any]
    step: Callable[..., Any]
    acceleration: Callable[..., Any]
    follow: Callable[..., Any]
    hover: Callable[..., Any] = no_control
    respond: Callable[..., Any] = follow_at_once
    parameters: type[ParameterSection] | None = None
