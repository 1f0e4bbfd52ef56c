"""A drone, a LiDAR and an autopilot in simulated time, without sockets, behind the interfaces that the node uses.

`Simulation.run` advances the time and steps control loop and watchdog. A plan takes `plan_time` of simulated time,
during which the control loop continues, because `SlowPlanner.plan` runs the simulation before it returns.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner import Plan, Planner, PlannerConfig, VehicleState
from aero_planner.mission_progress import MissionProgress
from aero_planner.missions import Mission
from aero_planner.onboard.dead_reckoning import MotionState, propagate
from aero_planner.onboard.failsafe_table import State
from aero_planner.onboard.interfaces import Observation, Observer, PointCounters, PointPacket, VehicleSample
from aero_planner.onboard.mission_offer import MissionOffer
from aero_planner.onboard.node import Node
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.stop_controller import StopController
from aero_planner.onboard.tuning import Tuning
from aero_planner.quaternions import conjugate, rotate

STEP = 0.005
"""Time step of the simulated vehicle [s]."""
SMALL = PlannerConfig().replace({"sampling.samples": 16, "costs.q_track": 5.0, "vehicle.speed_limit": 5.0})
"""The weight of the guides was the default when the limits of the tests were chosen."""
PLACES = [(4.0, 0.1), (6.0, -1.6), (6.2, 1.8), (8.0, 0.2), (10.0, -1.4), (11.0, 1.2), (13.0, 0.0)]
"""Positions of poles in the way from the origin to (18, 0) [m]."""


class Clock:
    """Host time set by the test [s]."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


def poles(places: Sequence[tuple[float, float]], *, radius: float = 0.25, height: float = 5.0) -> NDArray[np.float32]:
    """Return points on the surface of vertical poles [m], shape [P, 3], world frame."""
    angle, z = np.meshgrid(np.linspace(0, 2 * np.pi, 24, endpoint=False), np.arange(0.0, height, 0.08))
    ring = np.stack([radius * np.cos(angle).ravel(), radius * np.sin(angle).ravel(), z.ravel()], axis=1)
    return np.concatenate([ring + np.array([x, y, 0.0]) for x, y in places]).astype(np.float32)


def flying_north(now: float) -> MotionState:
    """Return the motion of a drone that is level and flies north at 4 m/s."""
    return MotionState(now, np.zeros(3), np.array([4.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0]))


class SimulatedLink:
    """An autopilot that, like PX4, leaves OFFBOARD 0.5 s after the last command."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self.state: VehicleSample | None = None
        self.goal: NDArray[np.float64] | None = None
        self.offer: MissionOffer | None = None
        self.progress: MissionProgress | None = None
        self.dropped: dict[str, int] = {}
        self.ignored: dict[str, int] = {}
        self.resets = 0
        self.thrust_gain = 1.0
        self.armed = self.offboard = False
        self.in_air: bool | None = True
        self.supported, self.transmitter, self.battery_low = True, True, False
        self.position_std, self.velocity_std = 0.2, 0.05
        self.fix_age = 0.1
        self.round_trip = 0.02
        self.ground_height = math.nan
        self.alive = True
        """False if nothing arrives from the vehicle."""
        self.frozen = False
        """True if states stop while heartbeats continue."""
        self.spoil: Callable[[VehicleState], VehicleState] = lambda state: state
        self.sent: list[tuple[float, NDArray[np.float64]]] = []
        self.closed = False
        self.heartbeat_period = 0.0
        """Time from one heartbeat to the next, which reports `armed` and `offboard`; 1 s with PX4."""
        self._heartbeat = -math.inf
        self._mode = False, False

    def poll(self) -> None:
        if not self.alive:
            return
        simulation = self._simulation
        now = simulation.now
        if now >= self._heartbeat + self.heartbeat_period - 1e-9:
            self._heartbeat, self._mode = now, (self.armed, self.offboard)
        motion, before = simulation.motion, self.state
        state = before.state if before is not None and self.frozen else self.spoil(
            VehicleState(motion.position, motion.velocity, motion.quaternion, None, motion.time)
        )  # fmt: skip
        time = before.time if before is not None and self.frozen else motion.time - simulation.state_delay
        self.state = VehicleSample(
            time, state, *self._mode, self._heartbeat, self.resets, self.in_air,
            self.position_std, self.velocity_std, now - self.fix_age, self.ground_height, self.supported,
            self.transmitter, self.battery_low, self.round_trip,
        )  # fmt: skip

    def send(self, command: ArrayLike, attitude: ArrayLike | None = None) -> None:
        values = np.array(command, dtype=np.float64)
        if values.shape != (4,) or not np.isfinite(values).all():
            raise ValueError(f"the command is {values.tolist()}")
        self.sent.append((self._simulation.now, values))

    def report_mission(self, progress: MissionProgress | None) -> None:
        self.progress = progress

    def close(self) -> None:
        self.closed = True


class SimulatedLidar:
    """Sees all points of the world within 10 m, every twentieth at each poll."""

    def __init__(self, simulation: Simulation, world: NDArray[np.float32]) -> None:
        self._simulation, self.world = simulation, world
        self.counters = PointCounters()
        self.alive = True
        self.spoil: Callable[[NDArray[np.float32]], NDArray[np.float32]] = lambda points: points
        self.closed = False

    def poll(self) -> list[PointPacket]:
        if not self.alive:
            return []
        motion = self._simulation.motion
        self.counters.packets += 1
        near = self.world[self.counters.packets % 20 :: 20] - motion.position
        near = near[np.linalg.norm(near, axis=1) < 10.0]
        inverse = conjugate(motion.quaternion)
        points = self.spoil(rotate(inverse, near).astype(np.float32))
        return [PointPacket(points, np.full(len(points), motion.time))]

    def close(self) -> None:
        self.closed = True


class Relay(Observer):
    """Passes on what the node reports to observers that may be set after the node is built."""

    def __init__(self) -> None:
        self.observers: list[Observer] = []

    def observe(self, item: Observation) -> None:
        for observer in self.observers:
            observer.observe(item)

    def close(self) -> None:
        for observer in self.observers:
            observer.close()


class SlowPlanner:
    """A planner whose plans take simulated time."""

    def __init__(self, planner: Planner, simulation: Simulation) -> None:
        self.simulation, self._planner = simulation, planner
        self.reserve_sweeps, self.reset, self.configure = planner.reserve_sweeps, planner.reset, planner.configure
        self.spoil: Callable[[Plan], Plan] = lambda plan: plan
        self.ageing = 0.0
        """Time added to the age of the cloud [s]."""
        self.options: dict[str, Any] = {}
        """Options of the newest call of `plan`."""

    @property
    def config(self) -> PlannerConfig:
        return self._planner.config

    def plan(self, *arguments: Any, cloud_age: float, **options: Any) -> Plan:
        self.options = options
        plan = self._planner.plan(*arguments, cloud_age=cloud_age + self.ageing, **options)
        self.simulation.run(self.simulation.plan_time)
        return self.spoil(plan)


class Simulation:
    """A node with everything that surrounds it.

    Args:
        planner: Shared between tests; its history is reset.
        world: Points of the obstacles [m], shape [P, 3], world frame.
        goal: [m], shape [3].
        plan_time: Duration of a plan [s].
        state_delay: Age of a state when it arrives [s].
        changes: Changes to the node's settings.
        observers: Observers of the node.
        tuning: Changes of the planner's parameters.
    """

    def __init__(
        self,
        planner: Planner,
        world: NDArray[np.float32],
        goal: ArrayLike | Mission | None = (30.0, 0.0, 2.0),
        *,
        plan_time: float = 0.04,
        state_delay: float = 0.0,
        changes: dict[str, Any] | None = None,
        observers: Sequence[Observer] = (),
        tuning: Tuning | None = None,
    ) -> None:
        planner.reset()
        self.now = 100.0
        self.plan_time, self.state_delay = plan_time, state_delay
        self.motion = MotionState(self.now, np.array([0.0, 0.0, 2.0]), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
        self.link = SimulatedLink(self)
        self.lidar = SimulatedLidar(self, world)
        self.planner = SlowPlanner(planner, self)
        config = OnboardConfig().replace(changes or {})
        self.node = Node(
            self.planner,  # type: ignore[arg-type]
            self.link,
            self.lidar,
            config,
            goal=goal,
            clock=lambda: self.now,
            observers=observers if tuning is None else [tuning, *observers],
            tuning=tuning,
        )
        self.control_alive = True
        """False if the control loop stalls."""
        self.wind = np.zeros(3)
        """Acceleration added to the drone in flight [m/s^2], shape [3]."""
        self.planning_alive = True
        self.path: list[NDArray[np.float64]] = []
        self.states: list[tuple[float, str]] = []
        self._vehicle = planner.config.vehicle
        self._response = config.response
        self._hold = StopController(self._vehicle, config.brake)
        self._control_period, self._plan_period = 1.0 / config.rates.control, 1.0 / config.rates.replan
        self._next_control = self._next_plan = self.now
        self._planning = False

    def run(self, seconds: float) -> None:
        """Advance the time."""
        end = self.now + seconds
        while self.now < end - 1e-9:
            self._fly(min(STEP, end - self.now))
            if self.now >= self._next_control - 1e-9:
                self._next_control += self._control_period
                if self.control_alive:
                    self.node.control_once()
                self.node.watch_once()
                self.path.append(self.motion.position)
                self.states.append((self.now, self.node.state.name))
            if not self._planning and self.planning_alive and self.now >= self._next_plan - 1e-9:
                self._planning = True
                self.node.plan_once()
                self._planning = False
                self._next_plan = max(self._next_plan + self._plan_period, self.now)

    def engage(self, timeout: float = 2.0) -> None:
        """Arm, and switch to OFFBOARD once commands have arrived for a while, as a pilot does."""
        self.run(0.3)
        self.link.armed = True
        end = self.now + timeout
        while self.now < end and not (len(self.link.sent) > 20 and self.now - self.link.sent[-1][0] < 0.1):
            self.run(0.05)
        self.link.offboard = True
        self.run(0.02)

    def run_until(self, condition: Callable[[], bool], timeout: float) -> bool:
        """Advance the time until `condition` is true; return False if it is not within `timeout` [s]."""
        end = self.now + timeout
        while self.now < end and not condition():
            self.run(0.02)
        return condition()

    def _fly(self, dt: float) -> None:
        link = self.link
        last = link.sent[-1] if link.sent else (-math.inf, None)
        if link.offboard and self.now - last[0] > 0.5:
            link.offboard = False
        if link.armed:
            obeys = link.offboard and last[1] is not None
            command = last[1] if obeys else self._hold.command(self.motion).control
            moved = propagate(self.motion, command, self.now + dt, self._vehicle, self._response)
            self.motion = dataclasses.replace(moved, velocity=moved.velocity + dt * self.wind)
        else:
            self.motion = MotionState(self.now + dt, self.motion.position, np.zeros(3), self.motion.quaternion)
        self.now += dt


WORLD = poles(PLACES)
GOAL = (18.0, 0.0, 2.0)
CORRIDOR = [(x, side * 2.5) for x in range(1, 20, 2) for side in (-1.0, 1.0)]
"""Positions of poles on both sides of the path to the goal, none of which a braking drone hits [m]."""


def in_flight(planner: Planner, **options: Any) -> Simulation:
    """Return a simulation in full flight, from the origin through the corridor to the goal."""
    simulation = Simulation(planner, poles(CORRIDOR), GOAL, **options)
    simulation.engage()
    assert simulation.run_until(lambda: simulation.motion.position[0] > 3.0, 5.0)
    assert simulation.node.state is State.FLYING and simulation.motion.speed > 2.0
    return simulation
