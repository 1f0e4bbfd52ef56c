"""Drive your own vehicle: a ground robot between pillars, commanded by its speed and yaw rate."""

from typing import Any

import warp as wp

import aero_planner
from aero_planner import registry
from aero_planner.device.quintics import Quintic, guide_position
from aero_planner.device.rotations import heading, quat_from_heading, wrap_angle
from aero_planner.models import VehicleModel
from aero_viz import flight
from aero_viz.scenes import scene

LEAD = wp.constant(0.3)  # how far the robot looks ahead on a guide [s]


@wp.func
def clamp(u: wp.vec4, c: Any) -> wp.vec4:  # c holds the live parameters by name
    return wp.vec4(wp.clamp(u[0], 0.0, c.speed_limit), wp.clamp(u[1], -c.rate_z_max, c.rate_z_max), 0.0, 0.0)


@wp.func
def noise(c: Any) -> wp.vec4:  # standard deviations
    return wp.vec4(0.5, 1.0, 0.0, 0.0)


@wp.func
def constants(disturbance: wp.vec3, drag: float, dt: float, c: Any) -> float:  # of all steps: their length alone
    return dt


@wp.func
def step(p: wp.vec3, v: wp.vec3, q: wp.vec4, acting: wp.vec4, u: wp.vec4, dt: float):
    yaw = heading(q) + dt * u[1]
    v = u[0] * wp.vec3(wp.cos(yaw), wp.sin(yaw), 0.0)
    return p + dt * v, v, quat_from_heading(yaw), u


@wp.func
def acceleration(v: wp.vec3, q: wp.vec4, acting: wp.vec4, dt: float) -> wp.vec3:
    return acting[1] * wp.vec3(-v[1], v[0], 0.0)


@wp.func
def follow(
    p: wp.vec3, v: wp.vec3, q: wp.vec4, acting: wp.vec4, guide: Quintic, t: float, rate: float, dt: float, c: Any
) -> wp.vec4:  # fmt: skip
    way = guide_position(guide, wp.min(t + LEAD, guide.T)) - p
    turn = wrap_angle(wp.atan2(way[1], way[0]) - heading(q)) * wp.min(1.0, 5.0 * wp.length(way))  # not at the end
    return clamp(wp.vec4(wp.length(way) * wp.max(0.0, wp.cos(turn)), turn, 0.0, 0.0) / LEAD, c)


controls = ("speed", "m/s"), ("yaw_rate", "rad/s"), ("unused_1", ""), ("unused_2", "")
robot = VehicleModel("robot", "Ground robot", controls, clamp, noise, constants, step, acceleration, follow)
registry.add("models", "robot", robot)  # before the configuration is made
config = aero_planner.PlannerConfig().replace({"vehicle.model": "robot", "vehicle.speed_limit": 1.5, "anchors.rows": 1})
result = flight.fly(scene("pillars", seed=1), config=config, rules=flight.FlightRules(arrival_radius=0.3))
print(f"{result.reason} after {result.length_m:.1f} m, at least {result.min_clearance:.2f} m from all pillars")
