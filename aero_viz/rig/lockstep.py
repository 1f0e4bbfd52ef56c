"""The rig in simulated time: autopilot, LiDAR, node and failsafe process in one process, one step after another.

The result does not depend on the load of the machine. Messages and packets travel over real sockets, and the failsafe
process's own code reads the node's heartbeats from its shared memory; only processes and threads are missing.
"""

from __future__ import annotations

import contextlib
import math
import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_planner import Planner
from aero_planner.onboard.connections import open_lidar, open_link
from aero_planner.onboard.failsafe_process import FailsafeGuard
from aero_planner.onboard.heartbeat_memory import HeartbeatMemory
from aero_planner.onboard.mavlink import MavlinkLink
from aero_planner.onboard.node import Node
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.watchdog import Heartbeat
from aero_planner.plan import Plan
from aero_planner.quaternions import rotate
from aero_viz.flight.rules import FlightRules
from aero_viz.flight.vehicle import VehicleModel
from aero_viz.rig.autopilot import PERIOD, SimulatedAutopilot
from aero_viz.rig.offboard import Mode
from aero_viz.rig.rig import HOST, PX4_RESPONSE, free_ports, ground_below, rig_settings
from aero_viz.rig.sensor import SimulatedMid360
from aero_viz.scenes import World
from aero_viz.sensors.lidar import LIDARS

__all__ = ["LockstepRig"]

_PILOT_PERIOD = 0.1  # [s] between two attempts of the pilot to take off


class _MemoryFailsafe:
    """The node's side of the failsafe process, without the process."""

    lost = False
    interventions = 0

    def __init__(self, memory: HeartbeatMemory, link: MavlinkLink) -> None:
        self._memory, self._link = memory, link

    @property
    def braking(self) -> bool:
        return self._memory.read_status().braking

    def report(self, heartbeat: Heartbeat) -> None:
        self._memory.write(heartbeat, self._link.peer, self._link.min_signing_time)
        self.interventions = self._memory.read_status().interventions

    def close(self) -> None:
        pass


class _SlowPlanner:
    """A planner whose plans take simulated time."""

    def __init__(self, planner: Planner, rig: LockstepRig, plan_time: float) -> None:
        self.config, self.device = planner.config, planner.device
        self.reserve_sweeps, self.reset = planner.reserve_sweeps, planner.reset
        self._planner, self._rig, self._plan_time = planner, rig, plan_time

    def plan(self, *arguments: Any, **options: Any) -> Plan:
        plan = self._planner.plan(*arguments, **options)
        self._rig.run(self._plan_time)
        return plan


class LockstepRig:
    """One flight in simulated time. Use it as a context manager.

    Args:
        planner: the planner; its history is reset, and its configuration is flown.
        world: where to fly.
        onboard: settings of the node; ports and the mount of the LiDAR are replaced.
        vehicle: model of the vehicle; None is the planner's with the response of PX4.
        loss_time: PX4's COM_OF_LOSS_T [s].
        plan_time: duration of a plan [s].
        seed: seed of the LiDAR and of gusts.

    Attributes:
        now: time since the start [s].
        autopilot, sensor, node, guard: the parts. `guard` does the work of the failsafe process.
        node_runs: False stops the node as SIGSTOP does.
        node_lives: False ends the node as SIGKILL does.
        min_clearance: smallest distance from the vehicle's centre to a surface since the take-over [m].
        speeds, tilts: speed [m/s] and tilt [rad] after each step since the take-over.
    """

    def __init__(
        self,
        planner: Planner,
        world: World,
        *,
        onboard: OnboardConfig | None = None,
        vehicle: VehicleModel | None = None,
        loss_time: float = 0.5,
        plan_time: float = 0.02,
        seed: int = 0,
    ) -> None:
        planner.reset()
        self.now = 0.0
        self.node_runs = self.node_lives = True
        self.min_clearance = math.inf
        self.speeds: list[float] = []
        self.tilts: list[float] = []
        self._world = world
        self._tick = 0
        self._planning = False
        config, lidar = planner.config, LIDARS["mid360"]
        lidar_port, mavlink_port = free_ports(2)
        onboard = (onboard or OnboardConfig()).replace(rig_settings(lidar, lidar_port, mavlink_port))
        self._control_period, self._plan_period = 1.0 / onboard.rates.control, 1.0 / onboard.rates.replan
        self._next_control = self._next_plan = self._next_guard = 0.0
        direction = world.goal - world.start
        self._resources = contextlib.ExitStack()
        with contextlib.ExitStack() as stack:
            self.autopilot = SimulatedAutopilot(
                vehicle or VehicleModel.from_config(config, **PX4_RESPONSE),
                world.start,
                math.atan2(direction[1], direction[0]),
                (HOST, mavlink_port),
                hover_thrust=onboard.thrust.hover_thrust,
                curve=onboard.thrust.curve,
                loss_time=loss_time,
                ground=ground_below(world),
                seed=seed,
            )
            stack.callback(self.autopilot.close)
            self.sensor = SimulatedMid360(world, lidar, (HOST, lidar_port), period=PERIOD, seed=seed)
            stack.callback(self.sensor.close)
            link = open_link(onboard, config.vehicle, clock=lambda: self.now)
            source = open_lidar(onboard, clock=lambda: self.now)
            file = HeartbeatMemory.create_file()
            memory, reader = HeartbeatMemory(file), HeartbeatMemory(file)
            os.close(file)
            self.guard = FailsafeGuard(reader, onboard, config.vehicle)
            stack.callback(self.guard.close)
            self.node = Node(
                _SlowPlanner(planner, self, plan_time),  # type: ignore[arg-type]
                link,
                source,
                onboard,
                goal=world.goal,
                clock=lambda: self.now,
                failsafe=_MemoryFailsafe(memory, link),
            )
            stack.callback(self.node.close)
            self._resources = stack.pop_all()

    def __enter__(self) -> LockstepRig:
        return self

    def __exit__(self, *_: object) -> None:
        self._resources.close()

    @property
    def speed(self) -> float:
        """Speed of the vehicle [m/s]."""
        return float(np.linalg.norm(self.autopilot.velocity))

    @property
    def tilt(self) -> float:
        """Angle between the vehicle's axis and the vertical [rad]."""
        axis = rotate(self._quaternion(), [0.0, 0.0, 1.0])
        return math.acos(min(1.0, float(axis[2])))

    @property
    def collided(self) -> bool:
        """True if the vehicle has touched a surface since the take-over."""
        return self.min_clearance < FlightRules().radius

    def take_over(self, timeout: float = 10.0) -> bool:
        """Arm and switch to OFFBOARD as the pilot does; return False if the node is not ready within `timeout` [s]."""
        end = self.now + timeout
        while self.now < end:
            self.run(_PILOT_PERIOD)
            if self.autopilot.ready_to_arm and not self.autopilot.armed:
                self.autopilot.arm()
            if self.autopilot.engage():
                return True
        return False

    def run(self, seconds: float) -> None:
        """Advance the time."""
        for _ in range(round(seconds / PERIOD)):
            self._step()

    def _step(self) -> None:
        self.now = (self._tick + 1) * PERIOD
        self.autopilot.step(self._tick, self.now)
        self.sensor.step(self._tick, self.autopilot.vehicle, self.now)
        self._tick += 1
        if self.autopilot.mode is Mode.OFFBOARD or self.speeds:
            self.speeds.append(self.speed)
            self.tilts.append(self.tilt)
            self.min_clearance = min(self.min_clearance, float(self._world.distance(self.autopilot.position[None])[0]))
        if self.now >= self._next_control:
            self._next_control += self._control_period
            if self.node_runs and self.node_lives:
                self.node.control_once()
                self.node.watch_once()
        if self.now >= self._next_guard:
            self._next_guard += self._control_period
            self.guard.check(self.now, is_alone=not self.node_lives)
        if not self._planning and self.node_runs and self.node_lives and self.now >= self._next_plan:
            self._planning = True
            self.node.plan_once()
            self._planning = False
            self._next_plan = max(self._next_plan + self._plan_period, self.now)

    def _quaternion(self) -> NDArray[np.float64]:
        values: Any = self.autopilot.vehicle.quaternion.numpy()
        return values[0].astype(np.float64)
