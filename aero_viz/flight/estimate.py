"""What the drone believes its state to be: the true state and errors that drift."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import warp as wp

from aero_planner.config.parameter import ParameterSection, live
from aero_viz.flight.vehicle import Vehicle

__all__ = ["StateEstimate", "StateNoise"]

wp.set_module_options({"enable_backward": False})

ERRORS = wp.constant(0x65737469)  # tells these random numbers from those of the other parts of a flight


@dataclass(frozen=True)
class StateNoise(ParameterSection, section="noise"):
    """Errors of the state estimate: standard deviations per axis of first-order processes, 0 for none.

    Sweeps are placed by the estimated pose, as on the drone, and so share the error of their time.

    Raises:
        ValueError: a parameter is outside its bounds.
    """

    position: float = live(0.0, "m", 0.0, 100.0, "Error of the position.")
    velocity: float = live(0.0, "m/s", 0.0, 100.0, "Error of the velocity.")
    attitude: float = live(0.0, "deg", 0.0, 180.0, "Error of the attitude, a rotation vector in body axes.")
    correlation_time: float = live(1.0, "s", 1e-3, 1e9, "Time after which an error has lost all but 1/e of itself.")


@wp.struct
class NoiseParameters:
    """`StateNoise` for kernels."""

    position: float
    velocity: float
    attitude: float
    """[rad]"""
    keep: float
    """Share of an error that is left after one tick."""


@wp.struct
class Errors:
    """Errors of one estimate: position [m], velocity [m/s], rotation vector in body axes [rad]."""

    position: wp.vec3
    velocity: wp.vec3
    attitude: wp.vec3


@wp.kernel
def estimate_kernel(
    noise: NoiseParameters,
    tick: int,
    seeds: wp.array(dtype=int),
    finished: wp.array(dtype=int),
    true_positions: wp.array(dtype=wp.vec3),
    true_velocities: wp.array(dtype=wp.vec3),
    true_quaternions: wp.array(dtype=wp.vec4),
    errors: wp.array(dtype=Errors),
    positions: wp.array(dtype=wp.vec3),
    velocities: wp.array(dtype=wp.vec3),
    quaternions: wp.array(dtype=wp.vec4),
    positions_before: wp.array(dtype=wp.vec3),
    quaternions_before: wp.array(dtype=wp.vec4),
):
    """e_k = keep e_(k-1) + sqrt(1 - keep^2) sigma n: the spread is sigma from the first tick on."""
    b = wp.tid()
    if finished[b] != 0:
        return
    random = wp.rand_init(seeds[b] ^ ERRORS, tick)
    keep = noise.keep
    if tick == 0:
        keep = 0.0
    fresh = wp.sqrt(1.0 - keep * keep)
    e = errors[b]
    n = wp.vec3(wp.randn(random), wp.randn(random), wp.randn(random))
    e.position = keep * e.position + fresh * noise.position * n
    n = wp.vec3(wp.randn(random), wp.randn(random), wp.randn(random))
    e.velocity = keep * e.velocity + fresh * noise.velocity * n
    n = wp.vec3(wp.randn(random), wp.randn(random), wp.randn(random))
    e.attitude = keep * e.attitude + fresh * noise.attitude * n
    errors[b] = e

    q = true_quaternions[b]
    turn = wp.quat_identity()
    angle = wp.length(e.attitude)
    if angle > 0.0:
        turn = wp.quat_from_axis_angle(e.attitude / angle, angle)
    turned = wp.normalize(wp.quat(q[1], q[2], q[3], q[0]) * turn)
    positions_before[b] = positions[b]
    quaternions_before[b] = quaternions[b]
    positions[b] = true_positions[b] + e.position
    velocities[b] = true_velocities[b] + e.velocity
    quaternions[b] = wp.vec4(turned[3], turned[0], turned[1], turned[2])
    if tick == 0:
        positions_before[b] = positions[b]
        quaternions_before[b] = quaternions[b]


class StateEstimate:
    """Estimated states of B vehicles. Without noise the arrays are the vehicle's own.

    Args:
        noise: None for the true states.
        vehicle: whose states are estimated.
        period: time of a tick [s].
        seeds: one per vehicle; an error depends on seed and tick only.

    Attributes:
        position, velocity: vec3 [B], world frame, SI.
        quaternion: body to world, w, x, y, z, vec4 [B].
        position_before, quaternion_before: pose at the tick before.
    """

    def __init__(self, noise: StateNoise | None, vehicle: Vehicle, *, period: float, seeds: Sequence[int]) -> None:
        self._noise = None
        self._vehicle = vehicle
        self.position, self.velocity, self.quaternion = vehicle.position, vehicle.velocity, vehicle.quaternion
        self.position_before, self.quaternion_before = vehicle.position_before, vehicle.quaternion_before
        if noise is None:
            return
        self._noise = NoiseParameters()
        self._noise.position, self._noise.velocity = noise.position, noise.velocity
        self._noise.attitude = math.radians(noise.attitude)
        self._noise.keep = math.exp(-period / noise.correlation_time)
        with wp.ScopedDevice(vehicle.position.device):
            self._seeds = wp.array([seed & 0x7FFFFFFF for seed in seeds], dtype=int)
            self._errors = wp.zeros(len(seeds), dtype=Errors)
        names = ("position", "velocity", "quaternion", "position_before", "quaternion_before")
        self._own = [wp.clone(getattr(vehicle, name)) for name in names]
        self.position, self.velocity, self.quaternion, self.position_before, self.quaternion_before = self._own

    def update(self, tick: int, *, finished: wp.array) -> None:
        """Estimate the vehicles' present states at the end of a tick, 0 at the start; finished ones keep theirs."""
        if self._noise is None:
            return
        v = self._vehicle
        inputs = [self._noise, tick, self._seeds, finished, v.position, v.velocity, v.quaternion]
        wp.launch(estimate_kernel, len(self._seeds), inputs, [self._errors, *self._own], device=v.position.device)

    def state(self) -> list[Any]:
        """Return the arrays that a checkpoint holds."""
        return [] if self._noise is None else [self._errors, *self._own]
