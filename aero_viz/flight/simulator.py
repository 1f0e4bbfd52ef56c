"""B flights in lock step: vehicle, collision, outcome, metrics and LiDAR, on the device without a round trip."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from aero_planner.config.parameter import ParameterSection, live, structural
from aero_planner.warp_init import quieten
from aero_viz.flight.estimate import StateEstimate, StateNoise
from aero_viz.flight.vehicle import Vehicle, VehicleModel
from aero_viz.scenes.device_worlds import DeviceWorlds
from aero_viz.scenes.geometry import Geometry, world_distance
from aero_viz.scenes.world import World
from aero_viz.sensors.lidar import Lidar, LidarModel

__all__ = ["OUTCOMES", "FlightRules", "Record", "Simulator"]

wp.set_module_options({"enable_backward": False})

OUTCOMES = (None, "arrived", "collision", "stall", "out_of_bounds", "timeout")
"""Outcome of a flight by number; 0 is still flying."""
FLYING = wp.constant(0)
ARRIVED = wp.constant(1)
COLLISION = wp.constant(2)
STALL = wp.constant(3)
OUT_OF_BOUNDS = wp.constant(4)
TIMEOUT = wp.constant(5)

_GPU_LANES = 32  # threads that share the search for the nearest primitive


@dataclass(frozen=True)
class FlightRules(ParameterSection, section="rules"):
    """When a flight ends. It ends with the tick in which a condition holds first; collision goes before arrival.

    Raises:
        ValueError: a parameter is outside its bounds.
    """

    period: float = live(
        0.02, "s", 1e-3, 1.0, "One tick: how long a command is held; the LiDAR's sweep takes a whole number of ticks."
    )
    ticks_per_plan: int = structural(
        1, 1, 1000,
        "Ticks flown under one plan: 1 plans at 50 Hz; 5, as on the drone, plans at 10 Hz and executes at 50 Hz.",
    )  # fmt: skip
    radius: float = live(
        0.25, "m", 1e-3, 100.0,
        "Collision: the centre comes closer than this to a surface, checked at every integration step.",
    )  # fmt: skip
    arrival_radius: float = live(1.0, "m", 1e-3, 1e3, "Arrival: the centre is within this distance of the goal.")
    stall_distance: float = live(
        1.0,
        "m",
        1e-3,
        1e3,
        "Stall: the smallest distance to the goal has not shrunk by this much within stall_time.",
    )
    stall_time: float = live(5.0, "s", 1e-3, 1e9, "Time within which the goal has to come stall_distance nearer.")
    time_limit: float = live(60.0, "s", 1e-3, 1e9, "Timeout: the flight has taken this long since its goal was set.")


@wp.struct
class Rules:
    """`FlightRules` for kernels."""

    period: float
    radius: float
    arrival_radius: float
    stall_distance: float
    stall_time: float
    time_limit: float


@wp.struct
class Record:
    """What is known of one flight."""

    goal: wp.vec3
    """[m], world frame."""
    ticks: int
    """Number of ticks until the end of the flight."""
    length: float
    """Of the path, through the positions at the ticks [m]."""
    speed_max: float
    """At the ticks [m/s]."""
    smoothness: float
    """Integral of |da/dt|^2 dt [m^2/s^5], see `judge_kernel`."""
    clearance_min: float
    """Smallest distance from the centre to a surface, at every integration step [m]."""
    clearance_sum: float
    clearance_count: int
    acceleration: wp.vec3
    """Mean over the last tick [m/s^2]."""
    velocity: wp.vec3
    """At the last tick [m/s]."""
    nearest_goal: float
    """Distance to the goal when progress was last noted [m]."""
    progress_time: float
    """Time of that [s]."""
    goal_tick: int
    """Number of ticks until the goal was set."""


@wp.kernel
def clear_kernel(clearance: wp.array2d(dtype=float)):
    b, s = wp.tid()
    clearance[b, s] = wp.inf


@wp.kernel
def clearance_kernel(
    geometry: Geometry,
    world: wp.array(dtype=int),
    finished: wp.array(dtype=int),
    trail: wp.array2d(dtype=wp.vec3),
    lanes: int,
    clearance: wp.array2d(dtype=float),
):
    b, s, lane = wp.tid()
    if finished[b] == 0:
        wp.atomic_min(clearance, b, s, world_distance(geometry, world[b], trail[b, s], lane, lanes))


@wp.kernel
def judge_kernel(
    rules: Rules,
    tick: int,
    lower: wp.array(dtype=wp.vec3),
    upper: wp.array(dtype=wp.vec3),
    positions: wp.array(dtype=wp.vec3),
    positions_before: wp.array(dtype=wp.vec3),
    velocities: wp.array(dtype=wp.vec3),
    clearance: wp.array2d(dtype=float),
    records: wp.array(dtype=Record),
    outcomes: wp.array(dtype=int),
):
    """Bring the records up to date and end flights; `tick` counts from 0 at the start.

    Smoothness is the sum of |a_k - a_(k-1)|^2 / dt over the ticks with a_k = (v_(k+1) - v_k) / dt, the mean
    acceleration of a tick, and a_(-1) = 0: the drone hovers before it starts. The trajectory's file gives the same.
    """
    b = wp.tid()
    if outcomes[b] != FLYING:
        return
    elapsed = float(tick) * rules.period
    r = records[b]
    position = positions[b]
    nearest = float(wp.inf)
    for s in range(clearance.shape[1]):
        nearest = wp.min(nearest, clearance[b, s])
        r.clearance_sum += clearance[b, s]
    r.clearance_count += clearance.shape[1]
    r.clearance_min = wp.min(r.clearance_min, nearest)
    if tick > 0:
        acceleration = (velocities[b] - r.velocity) / rules.period
        r.smoothness += wp.length_sq(acceleration - r.acceleration) / rules.period
        r.acceleration = acceleration
    r.velocity = velocities[b]
    r.length += wp.length(position - positions_before[b])
    r.speed_max = wp.max(r.speed_max, wp.length(velocities[b]))
    r.ticks = tick

    remaining = wp.length(r.goal - position)
    if remaining <= r.nearest_goal - rules.stall_distance:
        r.nearest_goal = remaining
        r.progress_time = elapsed
    inside = True
    for i in range(3):
        inside = inside and position[i] >= lower[b][i] and position[i] <= upper[b][i]

    outcome = FLYING
    if nearest < rules.radius:
        outcome = COLLISION
    elif remaining <= rules.arrival_radius:
        outcome = ARRIVED
    elif not inside:
        outcome = OUT_OF_BOUNDS
    elif elapsed - r.progress_time >= rules.stall_time:
        outcome = STALL
    elif float(tick - r.goal_tick) * rules.period >= rules.time_limit:
        outcome = TIMEOUT
    outcomes[b] = outcome
    records[b] = r


class Simulator:
    """B flights, each in its own world, that start together; nothing leaves the device unless asked for.

    Args:
        worlds: one per flight.
        lidar: of all drones.
        vehicle: of all drones.
        rules: when flights end.
        seeds: one per flight: LiDAR pattern, all noise. A flight's result does not depend on the batch around it.
        device: Warp device.
        noise: of the state estimate; None is the true state.

    Raises:
        ValueError: the sweep period is no whole number of ticks.

    Attributes:
        vehicle: true states, see `Vehicle`.
        estimate: estimated states, see `StateEstimate`.
        lidar: the sweep in progress, see `Lidar`.
        outcome: index into OUTCOMES, int [B], on the device.
        record: metrics, `Record` [B], on the device.
        tick: number of ticks flown.
        rules, noise, seeds: as given.
        observers: called after every tick, in this order.
    """

    def __init__(
        self,
        worlds: Sequence[World],
        *,
        lidar: LidarModel,
        vehicle: VehicleModel,
        rules: FlightRules,
        seeds: Sequence[int],
        device: Any = "cpu",
        noise: StateNoise | None = None,
    ) -> None:
        if len(worlds) == 0 or len(worlds) != len(seeds):
            raise ValueError(f"{len(worlds)} worlds and {len(seeds)} seeds; there must be one of each per flight.")
        ratio = 1.0 / (lidar.sweep_rate * rules.period)
        self.ticks_per_sweep = round(ratio)
        if self.ticks_per_sweep < 1 or abs(ratio - self.ticks_per_sweep) > 1e-6:
            raise ValueError(
                f"a sweep takes {1.0 / lidar.sweep_rate:g} s, no multiple of the tick of {rules.period:g} s; "
                f"set FlightRules.period to a fraction of it, such as {0.2 / lidar.sweep_rate:g}."
            )
        self.rules, self.noise, self.seeds = rules, noise, tuple(seeds)
        self.tick = 0
        self.observers: list[Callable[[], None]] = []
        quieten()
        self.device = wp.get_device(device)
        self._worlds = DeviceWorlds(worlds, device=self.device)
        starts = np.stack([world.start for world in worlds])
        goals = np.stack([world.goal for world in worlds])
        toward = goals - starts
        headings = np.arctan2(toward[:, 1], toward[:, 0])
        self.vehicle = Vehicle(vehicle, starts, headings, period=rules.period, device=self.device, seeds=seeds)
        self.estimate = StateEstimate(noise, self.vehicle, period=rules.period, seeds=seeds)
        self.lidar = Lidar(lidar, self._worlds, seeds=seeds)
        self._rules = Rules()
        for name in ("period", "radius", "arrival_radius", "stall_distance", "stall_time", "time_limit"):
            setattr(self._rules, name, getattr(rules, name))
        records = np.zeros(len(worlds), dtype=Record.numpy_dtype())
        records["goal"] = goals
        records["clearance_min"] = np.inf
        records["nearest_goal"] = np.linalg.norm(toward, axis=1)
        with wp.ScopedDevice(self.device):
            self._lower = wp.array([world.bounds[0] for world in worlds], dtype=wp.vec3)
            self._upper = wp.array([world.bounds[1] for world in worlds], dtype=wp.vec3)
            self._clearance = wp.empty(self.vehicle.trail.shape, dtype=float)
            self.record = wp.array(records, dtype=Record)
            self.outcome = wp.zeros(len(worlds), dtype=int)
        self.estimate.update(0, finished=self.outcome)
        self._judge()

    @property
    def time(self) -> float:
        """Since the start [s]."""
        return self.tick * self.rules.period

    def look(self, sweep: int) -> None:
        """Measure all of a sweep with a negative number from the first poses, as if hovering there before the start."""
        self._scan(sweep, 0, self.lidar.model.points_per_sweep)

    def advance(self, commands: wp.array, *, phase: float = 0.0) -> tuple[int, int, int]:
        """Fly one tick and scan.

        Args:
            commands: sequences of F_t [N] and omega [rad/s], vec4 [B, any].
            phase: place in the sequence of the command to hold, see `Vehicle.fly`.

        Returns:
            sweep, first, end: the points first .. end - 1 of `lidar.points` are new and belong to this sweep.
        """
        self.vehicle.fly(commands, finished=self.outcome, phase=phase, tick=self.tick)
        sweep, part = divmod(self.tick, self.ticks_per_sweep)
        self.tick += 1
        self.estimate.update(self.tick, finished=self.outcome)
        self._judge()
        size = self.lidar.model.points_per_sweep
        first, end = part * size // self.ticks_per_sweep, (part + 1) * size // self.ticks_per_sweep
        self._scan(sweep, first, end)
        for observer in self.observers:
            observer()
        return sweep, first, end

    def records(self) -> NDArray[Any]:
        """Return the `Record` of each flight as a structured array [B], a copy."""
        return self.record.numpy().copy()

    def outcomes(self) -> list[str | None]:
        """Return the outcome of each flight, None while flying."""
        return [OUTCOMES[i] for i in self.outcome.numpy()]

    def set_goal(self, positions: ArrayLike) -> None:
        """Move the goals to `positions` [m], [B, 3], world frame; flights that arrived, stalled or ran out of time go
        on, and have the whole time limit again."""
        records, outcome = self.records(), self.outcome.numpy().copy()
        records["goal"] = positions
        records["nearest_goal"] = np.linalg.norm(records["goal"] - self.vehicle.position.numpy(), axis=1)
        records["progress_time"] = self.time
        records["goal_tick"] = self.tick
        outcome[np.isin(outcome, (ARRIVED, STALL, TIMEOUT))] = FLYING
        self.record.assign(wp.array(records, dtype=Record, device="cpu"))
        self.outcome.assign(outcome)

    def checkpoint(self) -> tuple[int, list[NDArray[Any]]]:
        """Return tick and state, without the sweep in progress."""
        return self.tick, [array.numpy().copy() for array in self._state()]

    def restore(self, checkpoint: tuple[int, list[NDArray[Any]]]) -> None:
        """Continue from a checkpoint of this simulator."""
        self.tick, values = checkpoint
        for array, value in zip(self._state(), values, strict=True):
            array.assign(wp.array(value, dtype=array.dtype, device="cpu"))

    def _state(self) -> list[wp.array]:
        v = self.vehicle
        moving = [v.position, v.velocity, v.quaternion, v.acceleration, v.control, v.recent, v.wind]
        moving += [v.position_before, v.quaternion_before, *self.estimate.state()]
        return [*moving, self.record, self.outcome]

    def _judge(self) -> None:
        v, worlds = self.vehicle, self._worlds
        count, steps = v.trail.shape
        lanes = _GPU_LANES if self.device.is_cuda else 1
        wp.launch(clear_kernel, (count, steps), [], [self._clearance], device=self.device)
        inputs = [worlds.geometry, worlds.index, self.outcome, v.trail, lanes]
        wp.launch(clearance_kernel, (count, steps, lanes), inputs, [self._clearance], device=self.device)
        inputs = [self._rules, self.tick, self._lower, self._upper]
        inputs += [v.position, v.position_before, v.velocity, self._clearance]
        wp.launch(judge_kernel, count, inputs, [self.record, self.outcome], device=self.device)

    def _scan(self, sweep: int, first: int, end: int) -> None:
        v, e = self.vehicle, self.estimate
        self.lidar.scan(
            sweep,
            first,
            end,
            poses=(v.position, v.quaternion),
            poses_before=(v.position_before, v.quaternion_before),
            finished=self.outcome,
            believed=(e.position, e.quaternion),
            believed_before=(e.position_before, e.quaternion_before),
        )
