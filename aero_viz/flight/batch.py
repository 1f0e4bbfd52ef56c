"""Closed-loop flights: hundreds in lock step on a GPU, or one."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from aero_planner import Planner, PlannerConfig
from aero_viz.errors import UserError
from aero_viz.flight.estimate import StateNoise
from aero_viz.flight.explanation import explain, refuse_impossible
from aero_viz.flight.flight_end import FlightRecord
from aero_viz.flight.interrupt import FlightInterrupted, deferred_interrupt
from aero_viz.flight.metrics import FlightResult, flight_results
from aero_viz.flight.progress import distance_share
from aero_viz.flight.rules import FlightRules
from aero_viz.flight.simulator import Simulator
from aero_viz.flight.trajectory import trajectory_file
from aero_viz.flight.vehicle import VehicleModel
from aero_viz.scenes.world import World
from aero_viz.sensors.lidar import LidarModel, livox_mid360

__all__ = ["SWEEPS", "FlightBatch", "Progress", "Way", "fly"]

wp.set_module_options({"enable_backward": False})

SWEEPS = 10
"""Number of sweeps that the planner sees at once."""
Progress = Callable[[int, int, float], None]
"""Takes the number of flights that are over, the number of flights, and the simulated time [s]."""
Way = Callable[[float, float], None]
"""Takes the share of a single flight's way that is behind it, and the simulated time [s]."""
_CHECK_TICKS = 25  # on CUDA the host waits for the device only this often


@wp.kernel
def observe_kernel(
    time: wp.float64,
    records: wp.array(dtype=FlightRecord),
    positions: wp.array(dtype=wp.vec3),
    velocities: wp.array(dtype=wp.vec3),
    accelerations: wp.array(dtype=wp.vec3),
    quaternions: wp.array(dtype=wp.vec4),
    time_out: wp.array(dtype=wp.float64),
    goal_out: wp.array(dtype=wp.vec3),
    position_out: wp.array(dtype=wp.vec3),
    velocity_out: wp.array(dtype=wp.vec3),
    acceleration_out: wp.array(dtype=wp.vec3),
    quaternion_out: wp.array(dtype=wp.vec4),
):
    b = wp.tid()
    time_out[b] = time
    goal_out[b] = records[b].goal
    position_out[b] = positions[b]
    velocity_out[b] = velocities[b]
    acceleration_out[b] = accelerations[b]
    quaternion_out[b] = quaternions[b]


class FlightBatch:
    """B flights in lock step: plan, fly one tick, scan, with everything on the device.

    A flight takes about 6 MB there with the default configuration and LiDAR, see `memory_per_flight`.

    Args:
        worlds: one per flight; repeat a World object to fly it several times.
        config: of the planner: one for all, or one per flight with equal structure.
        device: Warp device.
        seed: flight b draws LiDAR pattern, noise and samples as a single flight with seed + b does.
        lidar: of all drones; None is the Livox Mid-360.
        vehicle: of all drones; None is the vehicle that the first configuration assumes.
        rules: when flights end, and how often is planned.
        noise: of the state estimates; None shows the planner the true states.
        config_names: names of the configurations in the results, one per flight; None finds preset names.
        threads: CPU threads of the planner; None for one per core.

    Raises:
        ValueError: there are no worlds, or an option does not fit the others.

    Attributes:
        simulator: states, outcomes, records.
        planner: its inputs, points and outputs are those of the last plan.
        interrupted: whether the last `run` was ended by Ctrl-C.
    """

    def __init__(
        self,
        worlds: Sequence[World],
        *,
        config: PlannerConfig | Sequence[PlannerConfig] | None = None,
        device: str = "cpu",
        seed: int = 0,
        lidar: LidarModel | None = None,
        vehicle: VehicleModel | None = None,
        rules: FlightRules | None = None,
        noise: StateNoise | None = None,
        config_names: Sequence[str] | None = None,
        threads: int | None = None,
    ) -> None:
        if len(worlds) == 0:
            raise ValueError("there are no worlds to fly; give one per flight.")
        config = config or PlannerConfig()
        configs = [config] * len(worlds) if isinstance(config, PlannerConfig) else list(config)
        names = {id(one): _preset_name(one) for one in configs} if config_names is None else {}
        self._config_names = list(config_names or (names[id(one)] for one in configs))
        self._worlds = list(worlds)
        self._seeds = [seed + b for b in range(len(worlds))]
        self._plan_ms: list[float] = []
        self._pending: list[tuple[wp.Event, wp.Event]] = []
        self.interrupted = False
        rules = rules or FlightRules()
        steps = {one.sampling.dt for one in configs}
        if rules.ticks_per_plan > 1 and len(steps) > 1:
            raise ValueError(
                "the configurations differ in sampling.dt; plans that are flown for several ticks need one."
            )
        self._phase_step = rules.period / steps.pop()

        self.planner = Planner(configs[0], device=device, seed=seed, batch=len(worlds), threads=threads)
        if not isinstance(config, PlannerConfig):
            self.planner.configure(configs)
        self.simulator = Simulator(
            worlds,
            lidar=lidar or livox_mid360(),
            vehicle=vehicle or VehicleModel.from_config(configs[0]),
            rules=rules,
            seeds=self._seeds,
            device=device,
            noise=noise,
        )
        self.planner.reserve(SWEEPS * self.simulator.lidar.model.points_per_sweep)
        heights = [-np.inf if world.ground_height is None else world.ground_height for world in worlds]
        self.planner.inputs.ground_height.assign(np.array(heights, dtype=np.float32))
        for sweep in range(-SWEEPS, 0):
            self.simulator.measure_sweep(sweep)
            self._publish(sweep)

    def step(self) -> None:
        """Plan, where it is time to, and fly one tick; flights that are over stay as they are."""
        part = self.simulator.tick % int(self.simulator.rules.ticks_per_plan)
        if part == 0:
            self._observe()
            self._plan()
        sweep, _, end = self.simulator.advance(self.planner.command, phase=part * self._phase_step)
        if end == self.simulator.lidar.model.points_per_sweep:
            self._publish(sweep)

    def is_done(self) -> bool:
        """Return whether all flights are over; waits for the device."""
        return self._count_finished() == len(self._worlds)

    def run(
        self, *, progress: Progress | None = None, each_tick: Callable[[], None] | None = None
    ) -> list[FlightResult]:
        """Fly until all flights are over, or until Ctrl-C: flights under way then have the reason None.

        Args:
            progress: called now and then, and at the end.
            each_tick: called after every tick.
        """
        ticks = _CHECK_TICKS if self.simulator.device.is_cuda and each_tick is None else 1
        total = len(self._worlds)
        self.interrupted = False
        with deferred_interrupt() as pressed:
            while True:
                finished = self._count_finished()
                if progress is not None:
                    progress(finished, total, self.simulator.time)
                if finished == total or pressed():
                    break
                for _ in range(ticks):
                    self.step()
                if each_tick is not None:
                    each_tick()
                self._collect_times()
            self.interrupted = finished < total
        return self.results()

    def results(self) -> list[FlightResult]:
        """Return what is known of each flight so far."""
        self._collect_times()
        records, outcomes, rules = self.simulator.records(), self.simulator.outcomes(), self.simulator.rules
        places = self.simulator.vehicle.position.numpy()
        told = [
            explain(
                outcome,
                world,
                place,
                time=float(record["ticks"]) * rules.period,
                clearance=float(record["clearance_min"]),
                goal=record["goal"],
                rules=rules,
            )
            for outcome, world, place, record in zip(outcomes, self._worlds, places, records, strict=True)
        ]
        return flight_results(
            records,
            outcomes,
            period=self.simulator.rules.period,
            seeds=self._seeds,
            scenes=[world.name for world in self._worlds],
            configs=self._config_names,
            plan_ms=statistics.median(self._plan_ms) if self._plan_ms else None,
            explanations=told,
        )

    def _count_finished(self) -> int:
        return int((self.simulator.outcome.numpy() != 0).sum())

    def _observe(self) -> None:
        estimate, inputs = self.simulator.estimate, self.planner.inputs
        state = [estimate.position, estimate.velocity, self.simulator.vehicle.acceleration, estimate.quaternion]
        outputs = [inputs.time, inputs.goal_position]
        outputs += [inputs.position, inputs.velocity, inputs.acceleration, inputs.quaternion]
        wp.launch(
            observe_kernel,
            len(self._worlds),
            [self.simulator.time, self.simulator.record, *state],
            outputs,
            device=self.simulator.device,
        )

    def _plan(self) -> None:
        if self.simulator.device.is_cuda:
            stream = self.simulator.device.stream
            started, ended = (wp.Event(self.simulator.device, enable_timing=True) for _ in range(2))
            stream.record_event(started)
            self.planner.launch()
            stream.record_event(ended)
            self._pending.append((started, ended))
        else:
            started = time.perf_counter()
            self.planner.launch()
            self._plan_ms.append(1e3 * (time.perf_counter() - started))

    def _collect_times(self) -> None:
        if self._pending:
            wp.synchronize_event(self._pending[-1][1])
            self._plan_ms += [wp.get_event_elapsed_time(*pair, synchronize=False) for pair in self._pending]
            self._pending.clear()

    def _publish(self, sweep: int) -> None:
        """Let the planner see a whole sweep, in the place of the oldest."""
        size = self.simulator.lidar.model.points_per_sweep
        first = sweep % SWEEPS * size
        place: Any = self.planner.points[:, first : first + size]
        wp.copy(place, self.simulator.lidar.points)


def fly(
    world: World,
    *,
    config: PlannerConfig | None = None,
    seed: int = 0,
    device: str = "cpu",
    lidar: LidarModel | None = None,
    vehicle: VehicleModel | None = None,
    rules: FlightRules | None = None,
    noise: StateNoise | None = None,
    speed: float | None = None,
    trajectory: str | Path | None = None,
    config_name: str | None = None,
    progress: Way | None = None,
) -> FlightResult:
    """Fly once, headless and as fast as possible.

    Args:
        world: where to fly.
        config: of the planner; None is the default.
        seed: of LiDAR and planner; same seed and device, same flight.
        device: Warp device.
        lidar, vehicle, rules, noise: as in `FlightBatch`.
        speed: replaces vehicle.speed_limit of the configuration [m/s].
        trajectory: CSV file to write while flying, t,x,y,z,vx,vy,vz at every tick, the start included.
        config_name: name of the configuration in the result; None finds a preset's name.
        progress: called now and then.

    Raises:
        FlightInterrupted: Ctrl-C; it has the result so far, and the trajectory's file holds what was flown.
        UserError: an option is out of range, no flight can arrive, the device does not exist, or the file cannot be
            written.
    """
    config = config or PlannerConfig()
    name = config_name or _preset_name(config)
    rules = rules or FlightRules()
    try:
        if speed is not None:
            config = config.replace({"vehicle.speed_limit": speed})
        refuse_impossible(world, rules=rules, speed_limit=config.vehicle.speed_limit)
        batch = FlightBatch(
            [world],
            config=config,
            seed=seed,
            device=device,
            lidar=lidar,
            vehicle=vehicle,
            rules=rules,
            noise=noise,
            config_names=[name],
        )
    except ValueError as error:
        raise UserError(f"Cannot fly {world.name!r}: {error}") from error
    simulator = batch.simulator

    def tell_way(finished: int, total: int, simulated: float) -> None:
        if progress is not None:
            progress(distance_share(world, simulator.vehicle.position.numpy()[0]), simulated)

    with trajectory_file(trajectory) as write_row:

        def write_tick() -> None:
            write_row(simulator.time, simulator.vehicle.position.numpy()[0], simulator.vehicle.velocity.numpy()[0])

        write_tick()
        result = batch.run(progress=tell_way, each_tick=None if trajectory is None else write_tick)[0]
    batch.planner.close()
    if batch.interrupted:
        raise FlightInterrupted(result)
    return result


def _preset_name(config: PlannerConfig) -> str:
    return next((name for name in PlannerConfig.presets() if PlannerConfig.preset(name) == config), "custom")
