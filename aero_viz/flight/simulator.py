"""Simulator of B flights in lock step: vehicle, collisions, outcomes, metrics and LiDAR stay on the device."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from aero_planner.warp_init import find_device
from aero_viz.flight.estimate import StateEstimate
from aero_viz.flight.flight_end import ARRIVED, FLYING, STALL, TIMEOUT, FlightRecord, clearance_kernel, judge_kernel
from aero_viz.flight.metrics import initial_records, pack_rules
from aero_viz.flight.rules import OUTCOMES, FlightRules
from aero_viz.flight.stage_timer import StageTimer
from aero_viz.flight.state_noise import StateNoise
from aero_viz.flight.vehicle import Vehicle
from aero_viz.flight.vehicle_model import VehicleModel
from aero_viz.scenes.device_worlds import DeviceWorlds
from aero_viz.scenes.world import World
from aero_viz.sensors.lidar import Lidar
from aero_viz.sensors.models import LidarModel

_WORLDS_MAX = 8  # worlds of the last settings that stay on the device
_WHOLE = 1e-6  # ticks by which a time may miss a tick by rounding
_GPU_THREADS_PER_QUERY = 32  # threads that share the search for the nearest primitive


@dataclass(frozen=True, eq=False)
class Setting:
    """Conditions that may change during a flight, besides the goal."""

    world: World
    lidar: LidarModel
    vehicle: VehicleModel
    noise: StateNoise | None


class Simulator:
    """B flights, each in its own world, that start together. Nothing leaves the device unless a method asks for it.

    Args:
        worlds: one per flight.
        lidar: model of the LiDAR of every drone.
        vehicle: model of every drone.
        rules: when flights end.
        seeds: one per flight, for the LiDAR pattern and all noise. The result of a flight does not depend on the other
            flights of the batch.
        device: Warp device.
        noise: errors of the state estimate; None makes it the true state.
        latency_max: largest latency of the drones that a later setting can have [s].

    Raises:
        ValueError: a sweep takes less than a tick.

    Attributes:
        vehicle: true states, see `Vehicle`.
        estimate: estimated states, see `StateEstimate`.
        lidar: LiDAR with the sweep in progress, see `Lidar`.
        outcome: index into OUTCOMES, int [B], on the device.
        active: mask, int [B], on the device: 1 while a flight is flying, else 0.
        record: metrics, `FlightRecord` [B], on the device.
        tick: number of ticks flown.
        ticks_per_sweep: mean number of ticks that a sweep takes, see `part_of_sweep`.
        rules, noise, seeds: the arguments.
        observers: called in this order after every tick.
        timer: measures the stages "vehicle" (motion, estimate and judgement) and "lidar"; None measures nothing.
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
        latency_max: float = 0.0,
    ) -> None:
        if len(worlds) == 0 or len(worlds) != len(seeds):
            raise ValueError(f"{len(worlds)} worlds and {len(seeds)} seeds; there must be one of each per flight.")
        self.ticks_per_sweep = 1.0 / (lidar.sweep_rate * rules.period)
        if self.ticks_per_sweep < 1.0 - _WHOLE:
            raise ValueError(
                f"a sweep takes {1.0 / lidar.sweep_rate:g} s, less than the tick of {rules.period:g} s; "
                f"set rules.period to a fraction of it, such as {0.2 / lidar.sweep_rate:g}."
            )
        self.rules, self.noise, self.seeds = rules, noise, tuple(seeds)
        self.tick = 0
        self.observers: list[Callable[[], None]] = []
        self.timer: StageTimer | None = None
        self.device = find_device(device)
        self._worlds = DeviceWorlds(worlds, device=self.device)
        starts = np.stack([world.start for world in worlds])
        goals = np.array([world.route.waypoints[0].at(0.0) for world in worlds])
        direction = goals - starts
        headings = np.arctan2(direction[:, 1], direction[:, 0])
        options: Any = {"seeds": seeds, "latency_max": latency_max}
        self.vehicle = Vehicle(vehicle, starts, headings, period=rules.period, device=self.device, **options)
        self.estimate = StateEstimate(noise, self.vehicle, period=rules.period, seeds=seeds)
        self.lidar = Lidar(lidar, self._worlds, seeds=seeds)
        self._known_worlds: dict[int, tuple[World, DeviceWorlds]] = {}
        """Worlds of the last settings, by their id."""
        self._rules = pack_rules(rules)
        with wp.ScopedDevice(self.device):
            self._lower = wp.array([world.bounds[0] for world in worlds], dtype=wp.vec3)
            self._upper = wp.array([world.bounds[1] for world in worlds], dtype=wp.vec3)
            self._clearance = wp.empty(self.vehicle.trail.shape, dtype=float)
            self.record = wp.array(initial_records(starts, goals), dtype=FlightRecord)
            self.outcome = wp.zeros(len(worlds), dtype=int)
            self.active = wp.ones(len(worlds), dtype=int)
        self.estimate.update(0, active=self.active)
        self._judge()

    @property
    def time(self) -> float:
        """Simulated time since the start [s]."""
        return self.tick * self.rules.period

    def use(self, setting: Setting) -> None:
        """Continue under another setting, in all flights. Sweeps in progress are not measured again.

        Raises:
            ValueError: the latency of the drone is too long, see `Vehicle.use`. Nothing changes.
        """
        self.vehicle.use(setting.vehicle)
        worlds = self._known_worlds.get(id(setting.world))
        if worlds is None or worlds[0] is not setting.world:
            worlds = (setting.world, DeviceWorlds([setting.world] * len(self.seeds), device=self.device))
            self._known_worlds[id(setting.world)] = worlds
            while len(self._known_worlds) > _WORLDS_MAX:
                del self._known_worlds[next(iter(self._known_worlds))]
        self._worlds = worlds[1]
        self.lidar.use(setting.lidar, self._worlds)
        if setting.noise != self.noise:
            self.noise = setting.noise
            self.estimate = StateEstimate(setting.noise, self.vehicle, period=self.rules.period, seeds=self.seeds)
            self.estimate.update(self.tick, active=self.active)

    def set_worlds(self, worlds: Sequence[World]) -> None:
        """Continue in other worlds with the same bounds, one per flight. Points that were measured stay."""
        self._worlds = DeviceWorlds(worlds, device=self.device)
        self.lidar.use(self.lidar.model, self._worlds)

    def measure_sweep(self, sweep: int) -> None:
        """Measure a whole sweep before the start, with a negative number, as if the drones hovered at their starts."""
        self._scan(sweep, 0, self.lidar.model.rays_per_sweep)

    def advance(self, commands: wp.array, *, phase: float = 0.0) -> tuple[int, int, int]:
        """Fly one tick and scan.

        Args:
            commands: sequences of F_t [N] and omega [rad/s], vec4 [B, any].
            phase: position in the sequence of the command to hold, see `Vehicle.fly`.

        Returns:
            sweep, first, end: points first .. end - 1 of `lidar.points` are new and belong to this sweep.
        """
        with self.timed("vehicle"):
            self.vehicle.fly(commands, active=self.active, phase=phase, tick=self.tick)
            sweep, part, parts = self.part_of_sweep(self.tick)
            self.tick += 1
            self.estimate.update(self.tick, active=self.active)
            self._judge()
        size = self.lidar.model.rays_per_sweep
        first, end = part * size // parts, (part + 1) * size // parts
        with self.timed("lidar"):
            self._scan(sweep, first, end)
        for observer in self.observers:
            observer()
        return sweep, first, end

    def part_of_sweep(self, tick: int) -> tuple[int, int, int]:
        """Return the sweep that a tick measures, which part of it, and in how many parts it is measured.

        A sweep begins with the first tick that is not before its time.
        """
        sweep = math.floor(tick / self.ticks_per_sweep + _WHOLE)
        start, following = (math.ceil(k * self.ticks_per_sweep - _WHOLE) for k in (sweep, sweep + 1))
        return sweep, tick - start, following - start

    def timed(self, stage: str) -> AbstractContextManager[None]:
        """Return a context whose time counts for a stage, if there is a timer."""
        return nullcontext() if self.timer is None else self.timer.stage(stage)

    def records(self) -> NDArray[Any]:
        """Return the `FlightRecord` of each flight as a structured array [B], a copy."""
        return self.record.numpy().copy()

    def outcomes(self) -> list[str | None]:
        """Return the outcome of each flight, None while it is flying."""
        return [OUTCOMES[i] for i in self.outcome.numpy()]

    def set_goal(self, positions: ArrayLike, *, is_last: bool = True) -> None:
        """Move the goals to `positions` [m], [B, 3], world frame.

        Flights that have arrived, stalled or run out of time continue, with the full time limit.

        Args:
            positions: the goals.
            is_last: False if another goal follows, so that neither an arrival nor a stall ends a flight.
        """
        self._continue((ARRIVED, STALL, TIMEOUT), goal=positions, is_last=int(is_last))

    def set_position(self, positions: ArrayLike) -> None:
        """Put the drones at `positions` [m], [B, 3], world frame, with their velocities. Every flight continues."""
        v, e = self.vehicle, self.estimate
        for array in (v.position, v.position_before, e.position, e.position_before):
            array.assign(np.asarray(positions, dtype=np.float32))
        v.trail.assign(np.repeat(np.asarray(positions, dtype=np.float32)[:, None], v.trail.shape[1], axis=1))
        self._continue(range(1, len(OUTCOMES)))

    def _continue(self, ended: Iterable[int], **changes: ArrayLike) -> None:
        """Change records, and let the flights with one of these outcomes fly on with the full time limit."""
        records, outcome = self.records(), self.outcome.numpy().copy()
        for name, value in changes.items():
            records[name] = value
        records["progress_position"] = self.vehicle.position.numpy()
        records["progress_tick"] = self.tick
        records["goal_tick"] = self.tick
        outcome[np.isin(outcome, list(ended))] = FLYING
        self.record.assign(wp.array(records, dtype=FlightRecord, device="cpu"))
        self.outcome.assign(outcome)
        self.active.assign((outcome == FLYING).astype(np.int32))

    def checkpoint(self) -> tuple[int, list[NDArray[Any]]]:
        """Return the tick and the state arrays, without the sweep in progress."""
        return self.tick, [array.numpy().copy() for array in self._state()]

    def restore(self, checkpoint: tuple[int, list[NDArray[Any]]]) -> None:
        """Continue from a checkpoint of this simulator."""
        self.tick, values = checkpoint
        for array, value in zip(self._state(), values, strict=True):
            array.assign(wp.array(value, dtype=array.dtype, device="cpu"))

    def _state(self) -> list[wp.array]:
        return [*self.vehicle.state(), *self.estimate.state(), self.record, self.outcome, self.active]

    def _judge(self) -> None:
        v, worlds = self.vehicle, self._worlds
        count, steps = v.trail.shape
        threads = _GPU_THREADS_PER_QUERY if self.device.is_cuda else 1
        self._clearance.fill_(math.inf)
        inputs = [worlds.geometry, worlds.index, threads, self.time, self.rules.period / steps]
        inputs += [self.active, v.trail]
        size = (count, steps, threads)
        wp.launch(clearance_kernel, size, inputs=inputs, outputs=[self._clearance], device=self.device)
        inputs = [self._rules, self.tick, self._lower, self._upper]
        inputs += [v.position, v.position_before, v.velocity, self._clearance]
        outputs = [self.record, self.outcome, self.active]
        wp.launch(judge_kernel, count, inputs=inputs, outputs=outputs, device=self.device)

    def _scan(self, sweep: int, first: int, end: int) -> None:
        v, e = self.vehicle, self.estimate
        self.lidar.scan(
            sweep,
            first,
            end,
            poses=(v.position, v.quaternion),
            poses_before=(v.position_before, v.quaternion_before),
            active=self.active,
            estimated_poses=(e.position, e.quaternion),
            estimated_poses_before=(e.position_before, e.quaternion_before),
        )
