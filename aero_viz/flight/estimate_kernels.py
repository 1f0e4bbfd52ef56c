"""Warp kernel of the estimated states: the true states and errors that drift."""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

ERRORS = wp.constant(0x65737469)  # separates the random numbers of the errors from those of other parts of a flight


@wp.struct
class NoiseParameters:
    """`StateNoise` for kernels."""

    position: float
    velocity: float
    attitude: float
    """[rad]"""
    decay: float
    """Share of an error that remains after one tick."""


@wp.struct
class Errors:
    """Errors of one estimate: position [m], velocity [m/s], rotation vector in body axes [rad]."""

    position: wp.vec3
    velocity: wp.vec3
    attitude: wp.vec3


@wp.kernel
def estimate_kernel(
    # problem
    noise: NoiseParameters,
    tick: int,
    seeds: wp.array(dtype=int),  # [B]
    # in
    active: wp.array(dtype=int),  # [B]
    true_positions: wp.array(dtype=wp.vec3),  # [B]
    true_velocities: wp.array(dtype=wp.vec3),  # [B]
    true_quaternions: wp.array(dtype=wp.vec4),  # [B]
    # in/out
    errors: wp.array(dtype=Errors),  # [B]
    positions: wp.array(dtype=wp.vec3),  # [B]
    velocities: wp.array(dtype=wp.vec3),  # [B]
    quaternions: wp.array(dtype=wp.vec4),  # [B]
    # out
    positions_before: wp.array(dtype=wp.vec3),  # [B]
    quaternions_before: wp.array(dtype=wp.vec4),  # [B]
):
    """Advance the errors by one tick and add them to the true states.

    e_k = decay e_(k-1) + sqrt(1 - decay^2) sigma n, so that the standard deviation is sigma from the first tick on.
    """
    b = wp.tid()
    if active[b] == 0:
        return
    random = wp.rand_init(seeds[b] ^ ERRORS, tick)
    decay = noise.decay
    if tick == 0:
        decay = 0.0
    innovation = wp.sqrt(1.0 - decay * decay)
    e = errors[b]
    n = wp.vec3(wp.randn(random), wp.randn(random), wp.randn(random))
    e.position = decay * e.position + innovation * noise.position * n
    n = wp.vec3(wp.randn(random), wp.randn(random), wp.randn(random))
    e.velocity = decay * e.velocity + innovation * noise.velocity * n
    n = wp.vec3(wp.randn(random), wp.randn(random), wp.randn(random))
    e.attitude = decay * e.attitude + innovation * noise.attitude * n
    errors[b] = e

    q = true_quaternions[b]
    rotation = wp.quat_identity()
    angle = wp.length(e.attitude)
    if angle > 0.0:
        rotation = wp.quat_from_axis_angle(e.attitude / angle, angle)
    estimated = wp.normalize(wp.quat(q[1], q[2], q[3], q[0]) * rotation)
    positions_before[b] = positions[b]
    quaternions_before[b] = quaternions[b]
    positions[b] = true_positions[b] + e.position
    velocities[b] = true_velocities[b] + e.velocity
    quaternions[b] = wp.vec4(estimated[3], estimated[0], estimated[1], estimated[2])
    if tick == 0:
        positions_before[b] = positions[b]
        quaternions_before[b] = quaternions[b]
