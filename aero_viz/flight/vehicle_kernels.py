"""Warp kernels of the simulated vehicles: their commands, latency and gusts, whatever the plant."""

# Postponed annotations are left out: kernels made for a plant refer to local names.

import functools

import warp as wp

from aero_planner.device.params import Params
from aero_viz.flight.motion import Motion, VehicleParameters
from aero_viz.flight.plants import Plant

wp.set_module_options({"enable_backward": False})

GUSTS = wp.constant(0x47757374)  # separates the random numbers of the gusts from those of other parts of a flight


@wp.struct
class Fleet:
    """States of B vehicles, see `Vehicle`."""

    position: wp.array(dtype=wp.vec3)  # [B]
    velocity: wp.array(dtype=wp.vec3)  # [B]
    quaternion: wp.array(dtype=wp.vec4)  # [B]
    acceleration: wp.array(dtype=wp.vec3)  # [B]
    control: wp.array(dtype=wp.vec4)  # [B]
    recent_commands: wp.array2d(dtype=wp.vec4)  # [B, H]
    wind: wp.array(dtype=wp.vec3)  # [B]
    position_before: wp.array(dtype=wp.vec3)  # [B]
    quaternion_before: wp.array(dtype=wp.vec4)  # [B]
    trail: wp.array2d(dtype=wp.vec3)  # [B, S]


@wp.func
def command_at(commands: wp.array2d(dtype=wp.vec4), b: int, phase: float):
    """Interpolate the controls of a sequence linearly at `phase`; the last ones after its end."""
    last = commands.shape[1] - 1
    i = int(phase)
    command = commands[b, wp.min(i, last)]
    return command + (phase - float(i)) * (commands[b, wp.min(i + 1, last)] - command)


@functools.cache
def fly_kernel(plant: Plant) -> wp.Kernel:
    """Return the kernel that flies vehicles for one tick."""
    clamp, step, acceleration = plant.clamp, plant.step, plant.acceleration

    @wp.kernel(module="unique", enable_backward=False)
    def fly_kernel(
        # problem
        v: VehicleParameters,
        c: Params,
        tick: int,
        seeds: wp.array(dtype=int),  # [B]
        # in
        commands: wp.array2d(dtype=wp.vec4),  # [B, any]
        phase: float,
        active: wp.array(dtype=int),  # [B]
        # in/out
        fleet: Fleet,
    ):
        """Hold one command for one tick, see `Vehicle.fly`."""
        b = wp.tid()
        if active[b] == 0:
            return
        state = Motion()
        state.position = fleet.position[b]
        state.velocity = fleet.velocity[b]
        state.quaternion = fleet.quaternion[b]
        fleet.position_before[b] = state.position
        fleet.quaternion_before[b] = state.quaternion
        for j in range(fleet.recent_commands.shape[1] - 1, 0, -1):
            fleet.recent_commands[b, j] = fleet.recent_commands[b, j - 1]
        fleet.recent_commands[b, 0] = clamp(command_at(commands, b, phase), v, c)
        steps = fleet.trail.shape[1]
        random = wp.rand_init(seeds[b] ^ GUSTS, tick)
        wind = fleet.wind[b]
        if tick == 0:
            wind = v.gust_speed * wp.vec3(wp.randn(random), wp.randn(random), wp.randn(random))
        spread = v.gust_speed * wp.sqrt(1.0 - v.gust_decay * v.gust_decay)
        control = fleet.control[b]
        for s in range(steps):
            if v.gust_speed > 0.0:
                wind = v.gust_decay * wind + spread * wp.vec3(wp.randn(random), wp.randn(random), wp.randn(random))
            command = fleet.recent_commands[b, (wp.max(v.latency - s, 0) + steps - 1) // steps]
            state, control = step(state, control, command, wind, v, c)
            fleet.trail[b, s] = state.position
        fleet.position[b] = state.position
        fleet.velocity[b] = state.velocity
        fleet.quaternion[b] = state.quaternion
        fleet.acceleration[b] = acceleration(state, control, wind, v, c)
        fleet.control[b] = control
        fleet.wind[b] = wind

    return fly_kernel


@functools.cache
def rest_kernel(plant: Plant) -> wp.Kernel:
    """Return the kernel that gives vehicles the controls at rest."""
    hover, rest = plant.hover, plant.rest

    @wp.kernel(module="unique", enable_backward=False)
    def rest_kernel(v: VehicleParameters, c: Params, fleet: Fleet):
        """Write the control in effect at rest, and the commands that keep it. Launched over [B]."""
        b = wp.tid()
        fleet.control[b] = rest(v, c)
        for j in range(fleet.recent_commands.shape[1]):
            fleet.recent_commands[b, j] = hover(v, c)

    return rest_kernel
