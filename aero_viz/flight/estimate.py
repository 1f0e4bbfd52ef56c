"""State estimates of simulated drones: the true states and errors that drift."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import warp as wp

from aero_viz.flight.estimate_kernels import Errors, NoiseParameters, estimate_kernel
from aero_viz.flight.state_noise import StateNoise
from aero_viz.flight.vehicle import Vehicle


class StateEstimate:
    """Estimated states of B vehicles. Without noise, its arrays are those of the vehicle.

    Args:
        noise: errors of the estimate; None for the true states.
        vehicle: vehicles whose states are estimated.
        period: duration of a tick [s].
        seeds: one per vehicle; an error depends on seed and tick only.

    Attributes:
        position, velocity: vec3 [B], world frame, SI.
        quaternion: body to world, w, x, y, z, vec4 [B].
        position_before, quaternion_before: pose one tick earlier.
    """

    def __init__(self, noise: StateNoise | None, vehicle: Vehicle, *, period: float, seeds: Sequence[int]) -> None:
        self._noise: Any = None
        self._vehicle = vehicle
        names = ("position", "velocity", "quaternion", "position_before", "quaternion_before")
        arrays = [getattr(vehicle, name) for name in names]
        self._arrays = arrays if noise is None else [wp.clone(array) for array in arrays]
        self.position, self.velocity, self.quaternion, self.position_before, self.quaternion_before = self._arrays
        if noise is None:
            return
        self._noise = NoiseParameters()
        self._noise.position, self._noise.velocity = noise.position, noise.velocity
        self._noise.attitude = math.radians(noise.attitude)
        self._noise.decay = math.exp(-period / noise.correlation_time)
        with wp.ScopedDevice(vehicle.position.device):
            self._seeds = wp.array([seed & 0x7FFFFFFF for seed in seeds], dtype=int)
            self._errors = wp.zeros(len(seeds), dtype=Errors)

    def update(self, tick: int, *, active: wp.array) -> None:
        """Estimate the current states of the vehicles at the end of a tick.

        Args:
            tick: number of ticks flown, 0 at the start.
            active: mask, int [B]; vehicles with 0 keep their estimates.
        """
        if self._noise is None:
            return
        v = self._vehicle
        inputs = [self._noise, tick, self._seeds, active, v.position, v.velocity, v.quaternion]
        outputs = [self._errors, *self._arrays]
        wp.launch(estimate_kernel, len(self._seeds), inputs=inputs, outputs=outputs, device=v.position.device)

    def state(self) -> list[Any]:
        """Return the arrays that a checkpoint holds."""
        return [] if self._noise is None else [self._errors, *self._arrays]
