"""Device memory of the planner: named arrays in few blocks, so that each plan needs one copy in and one copy out."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from aero_planner.config import PlannerConfig
from aero_planner.kernels.clearance import GRID
from aero_planner.kernels.guides import BRAKES
from aero_planner.kernels.kernel_tuning import block_type, widths
from aero_planner.kernels.mppi import NOISE_ROWS, PROBES, fill_noise
from aero_planner.kernels.partition import fill_directions

__all__ = [
    "Block",
    "as_values",
    "as_vectors",
    "fine_shape",
    "input_block",
    "list_capacity",
    "output_block",
    "padded_samples",
    "work_arrays",
]

Spec = dict[str, tuple[Any, tuple[int, ...]]]
_ALIGNMENT = 256


class Block:
    """Arrays that share one allocation, and with it one copy between host and device.

    Args:
        spec: dtype and shape of each array, by name.
        device: where the block lives.

    Attributes:
        arrays: the device arrays as a namespace.
    """

    def __init__(self, spec: Spec, device: wp.Device) -> None:
        self._layout: dict[str, tuple[int, np.dtype, tuple[int, ...]]] = {}
        self.arrays = SimpleNamespace()
        size = 0
        for name, (dtype, shape) in spec.items():
            size = -(-size // _ALIGNMENT) * _ALIGNMENT
            scalar = np.dtype(wp.dtype_to_numpy(getattr(dtype, "_wp_scalar_type_", dtype)))
            tail = tuple(getattr(dtype, "_shape_", ()))
            self._layout[name] = (size, scalar, (*shape, *tail))
            size += scalar.itemsize * int(np.prod((*shape, *tail)))
        self.memory = wp.zeros(max(size, 1), dtype=wp.uint8, device=device)
        for (name, (dtype, shape)), (offset, _, _) in zip(spec.items(), self._layout.values(), strict=True):
            view = wp.array(ptr=int(self.memory.ptr or 0) + offset, dtype=dtype, shape=shape, device=device)
            setattr(self.arrays, name, view)
        # On the CPU the host's bytes are the device's own.
        self._host = self.memory if device.is_cpu else wp.zeros(max(size, 1), dtype=wp.uint8, device="cpu", pinned=True)

    def _views(self, memory: np.ndarray) -> dict[str, np.ndarray]:
        views = {}
        for name, (offset, dtype, shape) in self._layout.items():
            size = dtype.itemsize * int(np.prod(shape))
            views[name] = memory[offset : offset + size].view(dtype).reshape(shape)
        return views

    def host(self) -> dict[str, np.ndarray]:
        """Return writable host views of all arrays; `upload` moves what was written to the device."""
        return self._views(self._host.numpy())

    def upload(self) -> None:
        """Copy the host's bytes to the device, ordered before later launches."""
        if self._host is not self.memory:
            wp.copy(self.memory, self._host)

    def download(self) -> dict[str, np.ndarray]:
        """Return host arrays of their own with the device's present values."""
        if self._host is not self.memory:
            wp.copy(self._host, self.memory)
            wp.synchronize_stream(self.memory.device)
        return self._views(self._host.numpy().copy())


def input_block(batch: int, device: wp.Device) -> Block:
    """State, goal and bookkeeping of each drone. A NaN goal velocity, goal quaternion or time means: derive it. The
    ground height is -inf where it is unknown."""
    vec3, vec4, shape = wp.vec3, wp.vec4, (batch,)
    spec: Spec = {
        "time": (wp.float64, shape),
        "position": (vec3, shape),
        "velocity": (vec3, shape),
        "quaternion": (vec4, shape),
        "acceleration": (vec3, shape),
        "goal_position": (vec3, shape),
        "goal_velocity": (vec3, shape),
        "goal_quaternion": (vec4, shape),
        "cloud_age": (wp.float32, shape),
        "ground_height": (wp.float32, shape),
        "point_count": (wp.int32, shape),
    }
    return Block(spec, device)


def output_block(config: PlannerConfig, batch: int, device: wp.Device) -> Block:
    """Everything that a Plan shows; after the M instances come the ways to brake, which it doesn't."""
    M, N = len(config.kinds), config.sampling.steps
    coarse = config.partition.coarse_rows * config.partition.coarse_columns
    fine = math.prod(fine_shape(config))
    vec3, vec4, real, integer = wp.vec3, wp.vec4, wp.float32, wp.int32
    spec: Spec = {
        "fine_range": (real, (batch, fine)),
        "occupied": (integer, (batch, fine)),
        "filtered": (vec3, (batch, fine)),
        "safe_range": (real, (batch, coarse)),
        "safe_direction": (vec3, (batch, coarse)),
        "initial_endpoint": (vec3, (batch, M + BRAKES)),
        "anchor": (vec3, (batch, M + BRAKES)),
        "coefficient": (vec3, (batch, M + BRAKES, 6)),
        "guide": (vec3, (batch, M + BRAKES, N + 1)),
        "controls": (vec4, (batch, M + BRAKES, N)),
        "positions": (vec3, (batch, M + BRAKES, N + 1)),
        "velocities": (vec3, (batch, M + BRAKES, N + 1)),
        "quaternions": (vec4, (batch, M + BRAKES, N + 1)),
        "cost": (real, (batch * M, padded_samples(config, device))),
        "S2": (real, (batch, M + BRAKES)),
        "J_goal": (real, (batch, M + BRAKES)),
        "J_col": (real, (batch, M + BRAKES)),
        "clearance": (real, (batch, M + BRAKES, N)),
        "best": (integer, (batch,)),
        "status": (integer, (batch,)),
        "braked": (integer, (batch,)),
        "dropped": (integer, (batch,)),
    }
    return Block(spec, device)


def fine_shape(config: PlannerConfig) -> tuple[int, int]:
    """Return the number of rows and columns of fine cells."""
    part = config.partition
    return part.coarse_rows * part.fine_cells, part.coarse_columns * part.fine_cells


def padded_samples(config: PlannerConfig, device: wp.Device) -> int:
    """Return K filled up to whole vectors; the samples past K are rolled out and not used."""
    of = widths(device)
    width = max(of.samples, of.sums)
    return -(-config.sampling.samples // width) * width


def as_vectors(array: wp.array, width: int) -> wp.array:
    """Return a view of a contiguous float array with its last axis in vectors of `width`."""
    shape = (*array.shape[:-1], array.shape[-1] // width)
    dtype = wp.types.vector(length=width, dtype=wp.float32)
    return wp.array(ptr=array.ptr, dtype=dtype, shape=shape, device=array.device)


def as_values(array: wp.array) -> wp.array:
    """Return a view of a contiguous array of vectors as floats, with its last axis and that of the vectors as one."""
    shape = (*array.shape[:-1], array.shape[-1] * array.dtype._length_)
    return wp.array(ptr=array.ptr, dtype=wp.float32, shape=shape, device=array.device)


def list_capacity(config: PlannerConfig, lanes: int, device: wp.Device) -> int:
    """Return how many points the list has room for in the layers of one lane: of three layers, those it may have."""
    rows = 3 if device.is_cpu else 1
    points = math.prod(fine_shape(config)) * rows * math.ceil(3 / lanes)
    width = widths(device).points
    return -(-points // width) * width


def work_arrays(config: PlannerConfig, batch: int, lanes: int, device: wp.Device) -> SimpleNamespace:
    """What only the kernels need."""
    M, N, K = len(config.kinds), config.sampling.steps, config.sampling.samples
    fine = math.prod(fine_shape(config))
    rows, padded = N + PROBES, padded_samples(config, device)
    blocks = lanes * list_capacity(config, lanes, device) // widths(device).points
    with wp.ScopedDevice(device):
        work = SimpleNamespace(
            quaternion=wp.zeros(batch, dtype=wp.vec4),
            goal_velocity=wp.zeros(batch, dtype=wp.vec3),
            goal_quaternion=wp.zeros(batch, dtype=wp.vec4),
            keys=wp.zeros((lanes, batch, fine), dtype=wp.uint64),
            reach=wp.zeros(batch, dtype=wp.float32),
            initial_direction=wp.zeros((batch, config.anchor_count), dtype=wp.vec3),
            total=wp.zeros((lanes, batch), dtype=wp.int32),
            end=wp.zeros((batch, GRID**3), dtype=wp.int32),
            directions=wp.zeros(fine_shape(config), dtype=wp.vec3),
            turn=wp.zeros((batch, M + BRAKES), dtype=wp.vec3),
            nominal=wp.zeros((batch, M + BRAKES, N), dtype=wp.vec4),
            sample_controls=wp.zeros((batch * M, N, 4, padded), dtype=wp.float32),
            sample_positions=wp.zeros((batch * M, rows, 3, padded), dtype=wp.float32),
            sample_clearance_cost=wp.zeros((batch * M, rows, K), dtype=wp.float32),
            weight=wp.zeros((batch * M, padded), dtype=wp.float32),
            terms=wp.zeros((batch, M + BRAKES, rows + N + 1), dtype=wp.vec4),
            dropped=wp.zeros((lanes, batch), dtype=wp.int32),
            scores=wp.zeros((batch, M + BRAKES), dtype=wp.vec2),
            noise=wp.zeros((N, 4, NOISE_ROWS), dtype=wp.float32),
            seed=wp.zeros(batch, dtype=wp.int32),
            tick=wp.zeros(batch, dtype=wp.int32),
            previous_controls=wp.zeros((batch, N), dtype=wp.vec4),
            previous_end=wp.zeros(batch, dtype=wp.vec3),
            previous_turn=wp.zeros(batch, dtype=wp.vec3),
            previous_time=wp.zeros(batch, dtype=wp.float64),
        )
        # The same memory twice, for reading and for writing.
        work.counts = wp.array(ptr=work.end.ptr, dtype=wp.vec4i, shape=(batch, GRID**3 // 4), device=device)
        work.coordinates = wp.zeros((batch, blocks, 3, widths(device).points), dtype=wp.float32)
        work.blocks = wp.array(
            ptr=work.coordinates.ptr, dtype=block_type(widths(device).points), shape=(batch, blocks), device=device
        )
        wp.launch(fill_directions, dim=work.directions.shape, inputs=[work.directions])
        wp.launch(fill_noise, dim=(N, NOISE_ROWS), inputs=[work.noise])
        work.keys.fill_(0xFFFFFFFFFFFFFFFF)
    return work
