"""The rig in simulated time: autopilot, LiDAR, node and failsafe process in one process, one step after another.

The result does not depend on the load of the machine. Messages and packets travel over real sockets, and the failsafe
process's own code reads the node's heartbeats from its shared memory; only processes and threads are missing.
"""

from __future__ import annotations

import contextlib
import math

import numpy as np

from aero_planner import Planner
from aero_planner.onboard.node import Node
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.telemetry import Telemetry
from aero_planner.quaternions import rotate
from aero_viz.flight.rules import FlightRules
from aero_viz.flight.vehicle_model import VehicleModel
from aero_viz.rig.autopilot import PERIOD, SimulatedAutopilot
from aero_viz.rig.lockstep_node import LockstepNode
from aero_viz.rig.offboard import Mode
from aero_viz.rig.rig import HOST, PX4_RESPONSE, free_ports, ground_below, rig_settings
from aero_viz.rig.sensor import SimulatedMid360
from aero_viz.scenes import World
from aero_viz.sensors.models import LIDARS, LidarModel

_PILOT_PERIOD = 0.1  # [s] between two attempts of the pilot to take off


class LockstepRig:
    """One flight in simulated time. Use it as a context manager.

    Args:
        planner: the planner; its history is reset, and its configuration is flown.
        world: where to fly.
        onboard: settings of the node; ports and the mount of the LiDAR are replaced.
        vehicle: model of the vehicle; None is the planner's with the response of PX4.
        lidar: None is the Mid-360.
        hover_thrust: thrust setpoint at which the vehicle hovers, in [0, 1]; None is what the node assumes.
        loss_time: PX4's COM_OF_LOSS_T [s].
        plan_time: duration of a plan [s].
        tuning_key: key of viewers who may change parameters, see `LockstepNode`.
        seed: seed of the LiDAR and of gusts.

    Attributes:
        now: time since the start [s].
        autopilot, sensor: the simulated drone.
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
        lidar: LidarModel | None = None,
        hover_thrust: float | None = None,
        loss_time: float = 0.5,
        plan_time: float = 0.02,
        tuning_key: bytes | None = None,
        seed: int = 0,
    ) -> None:
        self.now = 0.0
        self.min_clearance = math.inf
        self.speeds: list[float] = []
        self.tilts: list[float] = []
        self._world = world
        self._tick = 0
        config, lidar = planner.config, lidar or LIDARS["mid360"]
        lidar_port, mavlink_port = free_ports(2)
        onboard = (onboard or OnboardConfig()).replace(rig_settings(lidar, lidar_port, mavlink_port))
        direction = world.goal - world.start
        self._resources = contextlib.ExitStack()
        with contextlib.ExitStack() as stack:
            self.autopilot = SimulatedAutopilot(
                vehicle or VehicleModel.from_config(config, **PX4_RESPONSE),
                world.start,
                math.atan2(direction[1], direction[0]),
                (HOST, mavlink_port),
                hover_thrust=hover_thrust or onboard.thrust.hover_thrust,
                curve=onboard.thrust.curve,
                loss_time=loss_time,
                ground=ground_below(world),
                seed=seed,
            )
            stack.callback(self.autopilot.close)
            self.sensor = SimulatedMid360(world, lidar, (HOST, lidar_port), period=PERIOD, seed=seed)
            stack.callback(self.sensor.close)
            self._process = LockstepNode(
                planner,
                onboard,
                clock=lambda: self.now,
                advance=self.run,
                goal=world.goal,
                plan_time=plan_time,
                tuning_key=tuning_key,
            )
            stack.callback(self._process.close)
            self._process.start()
            self._resources = stack.pop_all()

    def __enter__(self) -> LockstepRig:
        return self

    def __exit__(self, *_: object) -> None:
        self._resources.close()

    @property
    def node(self) -> Node:
        """The node."""
        assert self._process.node is not None
        return self._process.node

    @property
    def telemetry(self) -> Telemetry:
        """Server of the viewers, if the rig was given a key."""
        assert self._process.telemetry is not None
        return self._process.telemetry

    @property
    def node_runs(self) -> bool:
        """False stops the node as SIGSTOP does."""
        return self._process.runs

    @node_runs.setter
    def node_runs(self, runs: bool) -> None:
        self._process.runs = runs

    @property
    def node_lives(self) -> bool:
        """False ends the node as SIGKILL does."""
        return self._process.lives

    @node_lives.setter
    def node_lives(self, lives: bool) -> None:
        if not lives:
            self._process.kill()

    @property
    def speed(self) -> float:
        """Speed of the vehicle [m/s]."""
        return float(np.linalg.norm(self.autopilot.velocity))

    @property
    def tilt(self) -> float:
        """Angle between the vehicle's axis and the vertical [rad]."""
        axis = rotate(self.autopilot.quaternion, [0.0, 0.0, 1.0])
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
        end = self._tick + round(seconds / PERIOD)
        while self._tick < end:  # a step in which the node plans takes several
            self._step()

    def _step(self) -> None:
        self.now = (self._tick + 1) * PERIOD
        self.autopilot.step(self._tick, self.now)
        self.sensor.step(self._tick, self.autopilot.vehicle, self.now)
        self._tick += 1
        if self.autopilot.mode is Mode.OFFBOARD or self.speeds:
            self.speeds.append(self.speed)
            self.tilts.append(self.tilt)
            clearance = float(self._world.distance(self.autopilot.position, self.now)[0])
            self.min_clearance = min(self.min_clearance, clearance)
        self._process.step(self.now)
