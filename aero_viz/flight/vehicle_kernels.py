"""Warp kernels of the simulated quadrotor: Runge-Kutta integration with lags, latency, drag and gusts."""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

GUSTS = wp.constant(0x47757374)  # separates the random numbers of the gusts from those of other parts of a flight


@wp.struct
class VehicleParameters:
    """`VehicleModel` for kernels. A response is the share of a change that happens within one step."""

    mass: float
    gravity: float
    thrust_min: float
    thrust_max: float
    rate_xy_max: float
    rate_z_max: float
    thrust_response: float
    rate_response: float
    drag: float
    step: float
    latency: int
    """Number of integration steps."""
    gust_decay: float
    """Share of the wind that remains after one step."""
    gust_speed: float


@wp.struct
class Motion:
    """Position [m], velocity [m/s] and quaternion (w, x, y, z, body to world) of a state, or their derivatives."""

    position: wp.vec3
    velocity: wp.vec3
    quaternion: wp.vec4


@wp.func
def thrust_acceleration(q: wp.vec4, control: wp.vec4, mass: float):
    """R(q) [0, 0, F_t] / m [m/s^2]."""
    axis = wp.vec3(
        2.0 * (q[1] * q[3] + q[0] * q[2]),
        2.0 * (q[2] * q[3] - q[0] * q[1]),
        q[0] * q[0] - q[1] * q[1] - q[2] * q[2] + q[3] * q[3],
    )
    return (control[0] / mass) * axis


@wp.func
def total_acceleration(v: VehicleParameters, state: Motion, control: wp.vec4, wind: wp.vec3):
    """dv = R(q) [0, 0, F_t] / m + g - k (v - w) [m/s^2]."""
    gravity = wp.vec3(0.0, 0.0, v.gravity)
    return thrust_acceleration(state.quaternion, control, v.mass) - gravity - v.drag * (state.velocity - wind)


@wp.func
def derivative(v: VehicleParameters, state: Motion, control: wp.vec4, wind: wp.vec3):
    """dp = v; dv = R(q) [0, 0, F_t] / m + g - k (v - w); dq = 1/2 q (x) [0, omega]."""
    q = state.quaternion
    x = control[1]
    y = control[2]
    z = control[3]
    rate = Motion()
    rate.position = state.velocity
    rate.velocity = total_acceleration(v, state, control, wind)
    rate.quaternion = 0.5 * wp.vec4(
        -q[1] * x - q[2] * y - q[3] * z,
        q[0] * x + q[2] * z - q[3] * y,
        q[0] * y + q[3] * x - q[1] * z,
        q[0] * z + q[1] * y - q[2] * x,
    )
    return rate


@wp.func
def extrapolate(state: Motion, rate: Motion, time: float):
    """Return state + time * rate."""
    result = Motion()
    result.position = state.position + time * rate.position
    result.velocity = state.velocity + time * rate.velocity
    result.quaternion = state.quaternion + time * rate.quaternion
    return result


@wp.func
def runge_kutta(v: VehicleParameters, state: Motion, control: wp.vec4, wind: wp.vec3):
    """Integrate one RK4 step under constant controls and wind, and normalise the quaternion."""
    h = v.step
    k1 = derivative(v, state, control, wind)
    k2 = derivative(v, extrapolate(state, k1, 0.5 * h), control, wind)
    k3 = derivative(v, extrapolate(state, k2, 0.5 * h), control, wind)
    k4 = derivative(v, extrapolate(state, k3, h), control, wind)
    mean = Motion()
    mean.position = (k1.position + 2.0 * k2.position + 2.0 * k3.position + k4.position) / 6.0
    mean.velocity = (k1.velocity + 2.0 * k2.velocity + 2.0 * k3.velocity + k4.velocity) / 6.0
    mean.quaternion = (k1.quaternion + 2.0 * k2.quaternion + 2.0 * k3.quaternion + k4.quaternion) / 6.0
    result = extrapolate(state, mean, h)
    result.quaternion = wp.normalize(result.quaternion)
    return result


@wp.func
def clamp_control(v: VehicleParameters, control: wp.vec4):
    return wp.vec4(
        wp.clamp(control[0], v.thrust_min, v.thrust_max),
        wp.clamp(control[1], -v.rate_xy_max, v.rate_xy_max),
        wp.clamp(control[2], -v.rate_xy_max, v.rate_xy_max),
        wp.clamp(control[3], -v.rate_z_max, v.rate_z_max),
    )


@wp.func
def command_at(commands: wp.array2d(dtype=wp.vec4), b: int, phase: float):
    """Interpolate the controls of a sequence linearly at `phase`; the last ones after its end."""
    last = commands.shape[1] - 1
    i = int(phase)
    command = commands[b, wp.min(i, last)]
    return command + (phase - float(i)) * (commands[b, wp.min(i + 1, last)] - command)


@wp.kernel
def fly_kernel(
    # problem
    v: VehicleParameters,
    tick: int,
    seeds: wp.array(dtype=int),  # [B]
    # in
    commands: wp.array2d(dtype=wp.vec4),  # [B, any]
    phase: float,
    active: wp.array(dtype=int),  # [B]
    # in/out
    positions: wp.array(dtype=wp.vec3),  # [B]
    velocities: wp.array(dtype=wp.vec3),  # [B]
    quaternions: wp.array(dtype=wp.vec4),  # [B]
    accelerations: wp.array(dtype=wp.vec3),  # [B]
    controls: wp.array(dtype=wp.vec4),  # [B]
    recent_commands: wp.array2d(dtype=wp.vec4),  # [B, H]
    winds: wp.array(dtype=wp.vec3),  # [B]
    # out
    positions_before: wp.array(dtype=wp.vec3),  # [B]
    quaternions_before: wp.array(dtype=wp.vec4),  # [B]
    trail: wp.array2d(dtype=wp.vec3),  # [B, S]
):
    """Hold one command for one tick, see `Vehicle.fly`."""
    b = wp.tid()
    if active[b] == 0:
        return
    state = Motion()
    state.position = positions[b]
    state.velocity = velocities[b]
    state.quaternion = quaternions[b]
    positions_before[b] = state.position
    quaternions_before[b] = state.quaternion
    for j in range(recent_commands.shape[1] - 1, 0, -1):
        recent_commands[b, j] = recent_commands[b, j - 1]
    recent_commands[b, 0] = clamp_control(v, command_at(commands, b, phase))
    steps = trail.shape[1]
    random = wp.rand_init(seeds[b] ^ GUSTS, tick)
    wind = winds[b]
    if tick == 0:
        wind = v.gust_speed * wp.vec3(wp.randn(random), wp.randn(random), wp.randn(random))
    spread = v.gust_speed * wp.sqrt(1.0 - v.gust_decay * v.gust_decay)
    response = wp.vec4(v.thrust_response, v.rate_response, v.rate_response, v.rate_response)
    control = controls[b]
    for s in range(steps):
        if v.gust_speed > 0.0:
            wind = v.gust_decay * wind + spread * wp.vec3(wp.randn(random), wp.randn(random), wp.randn(random))
        command = recent_commands[b, (wp.max(v.latency - s, 0) + steps - 1) // steps]
        control = control + wp.cw_mul(response, command - control)
        state = runge_kutta(v, state, control, wind)
        trail[b, s] = state.position
    positions[b] = state.position
    velocities[b] = state.velocity
    quaternions[b] = state.quaternion
    accelerations[b] = total_acceleration(v, state, control, wind)
    controls[b] = control
    winds[b] = wind
