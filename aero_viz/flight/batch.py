"""Hundreds of closed-loop flights in lock step on a device."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence

import numpy as np
import warp as wp

from aero_planner import Planner, PlannerConfig
from aero_planner.exclusive import Use, exclusive
from aero_planner.seeds import Seeds, seeds_of_batch
from aero_viz.flight.flight_end import FlightRecord
from aero_viz.flight.interrupt import deferred_interrupt
from aero_viz.flight.known_drone import config_for_drone
from aero_viz.flight.memory import SWEEPS, WHOLE_SWEEPS, remembered_sweeps
from aero_viz.flight.metrics import FlightResult, flight_results
from aero_viz.flight.rules import FlightRules
from aero_viz.flight.simulator import Simulator
from aero_viz.flight.stage_timer import StageTimer
from aero_viz.flight.state_noise import StateNoise
from aero_viz.flight.vehicle_model import VehicleModel
from aero_viz.scenes.world import World
from aero_viz.sensors.models import LIDARS, LidarModel

wp.set_module_options({"enable_backward": False})

BatchProgress = Callable[[int, int, float], None]
"""Called with the number of finished flights, the number of all flights, and the simulated time [s]."""
_TIMED_PLANS = 5
_CUDA_TICKS_PER_CHECK = 25  # on CUDA, the host waits for the device only this often


@wp.kernel
def observe_kernel(
    # in
    time: wp.float64,
    records: wp.array(dtype=FlightRecord),  # [B]
    positions: wp.array(dtype=wp.vec3),  # [B]
    velocities: wp.array(dtype=wp.vec3),  # [B]
    accelerations: wp.array(dtype=wp.vec3),  # [B]
    quaternions: wp.array(dtype=wp.vec4),  # [B]
    # out
    time_out: wp.array(dtype=wp.float64),  # [B]
    goal_out: wp.array(dtype=wp.vec3),  # [B]
    position_out: wp.array(dtype=wp.vec3),  # [B]
    velocity_out: wp.array(dtype=wp.vec3),  # [B]
    acceleration_out: wp.array(dtype=wp.vec3),  # [B]
    quaternion_out: wp.array(dtype=wp.vec4),  # [B]
):
    """Copy time, goals and estimated states to the inputs of the planner."""
    b = wp.tid()
    time_out[b] = time
    goal_out[b] = records[b].goal
    position_out[b] = positions[b]
    velocity_out[b] = velocities[b]
    acceleration_out[b] = accelerations[b]
    quaternion_out[b] = quaternions[b]


class FlightBatch:
    """B flights in lock step. Every tick plans, flies and scans; all data stay on the device.

    A flight takes about 21 MB of device memory with the default configuration and LiDAR. One that is over takes little
    time. One thread at a time may use a batch.

    Args:
        worlds: one per flight; repeat a World object to fly it several times.
        config: configuration of the planner: one for all flights, or one per flight with equal structure.
        device: Warp device.
        seed: flight b has the LiDAR pattern, noise and samples of a single flight with seed + b, or with the b-th seed
            if a sequence of B seeds is given.
        lidar: model of every LiDAR; None is the Livox Mid-360.
        vehicle: model of every drone, which follows commands as the vehicle model of the first configuration has them;
            None is the vehicle that this configuration assumes.
        rules: when flights end, and how many ticks are flown under one plan.
        noise: errors of the state estimates; None gives the planner the true states.
        config_names: names of the configurations in the results, one per flight; None is the name of an equal preset,
            or "custom".
        threads: CPU threads of the planner; None is one per core.

    Raises:
        ValueError: there are no worlds, or an option does not fit the others.

    Attributes:
        simulator: states, outcomes and records.
        planner: its inputs and outputs are those of the last plan; the outputs of flights that are over mean nothing.
        interrupted: True if Ctrl-C was pressed during the last `run`, even if all its flights were over by then.
    """

    def __init__(
        self,
        worlds: Sequence[World],
        *,
        config: PlannerConfig | Sequence[PlannerConfig] | None = None,
        device: str = "cpu",
        seed: Seeds = 0,
        lidar: LidarModel | None = None,
        vehicle: VehicleModel | None = None,
        rules: FlightRules | None = None,
        noise: StateNoise | None = None,
        config_names: Sequence[str] | None = None,
        threads: int | None = None,
    ) -> None:
        if len(worlds) == 0:
            raise ValueError("there are no worlds to fly; give one per flight.")
        for world in worlds:
            if world.mission is not None:
                raise ValueError(
                    f"the world {world.name!r} has a mission, which a batch cannot fly; use SerialFlights."
                )
        config = PlannerConfig() if config is None else config
        configs = [config] * len(worlds) if isinstance(config, PlannerConfig) else list(config)
        names = {id(c): c.preset_name for c in configs} if config_names is None else {}
        self._config_names = [names[id(c)] for c in configs] if config_names is None else list(config_names)
        self._seeds = seeds_of_batch(seed, len(worlds))
        per_flight = {"configurations": configs, "names of configurations": self._config_names, "seeds": self._seeds}
        for noun, values in per_flight.items():
            if len(values) != len(worlds):
                raise ValueError(f"{len(values)} {noun} were given for {len(worlds)} flights; give one for each.")
        self._use = Use("batch of flights")
        self._worlds = list(worlds)
        self._plan_ms: list[float] = []
        self._pending: list[tuple[wp.Event, wp.Event]] = []
        self.interrupted = False
        rules, lidar = rules or FlightRules(), lidar or LIDARS["mid360"]
        vehicle = vehicle.commanded_by(configs[0]) if vehicle else VehicleModel.from_config(configs[0])
        configs = [
            config_for_drone(c, lidar=lidar, vehicle=vehicle, world=world)
            for c, world in zip(configs, worlds, strict=True)
        ]
        time_steps = {c.control_step for c in configs}
        if rules.ticks_per_plan > 1 and len(time_steps) > 1:
            raise ValueError(
                "the configurations differ in sampling.dt; plans that are flown for several ticks need the same."
            )
        self._phase_step = rules.period / time_steps.pop()

        self.planner = Planner(configs[0], device=device, seed=self._seeds, batch=len(worlds), threads=threads)
        if any(c != configs[0] for c in configs):
            self.planner.configure(configs)
        self.simulator = Simulator(
            worlds, lidar=lidar, vehicle=vehicle, rules=rules, seeds=self._seeds, device=device, noise=noise
        )
        remembered = [remembered_sweeps(c.sweep_memory, lidar) for c in configs]
        self._rows = max(remembered)
        """Number of sweeps in the planner's memory."""
        points = self._rows * self.simulator.lidar.model.rays_per_sweep
        self.planner.reserve_sweeps(self._rows, points, whole=WHOLE_SWEEPS, remembered=remembered)
        heights = [-np.inf if world.ground_height is None else world.ground_height for world in worlds]
        self.planner.inputs.ground_height.assign(np.array(heights, dtype=np.float32))
        self._observe()
        self._lost_sweeps = np.zeros(len(worlds))
        """Number of the newest sweeps of each flight that were lost, [B]."""
        for sweep in range(-SWEEPS, 0):
            self.simulator.measure_sweep(sweep)
            self._store(sweep)

    @exclusive
    def step(self) -> None:
        """Fly one tick, and plan before it if a new plan is due. Finished flights do not change."""
        part = self.simulator.tick % int(self.simulator.rules.ticks_per_plan)
        if part == 0:
            with self.simulator.timed("planner"):
                self._observe()
                self._plan()
        sweep, _, end = self.simulator.advance(self.planner.command, phase=part * self._phase_step)
        if end == self.simulator.lidar.model.rays_per_sweep:
            with self.simulator.timed("sweeps"):
                self._store(sweep)

    @exclusive
    def set_worlds(self, worlds: Sequence[World]) -> None:
        """Fly on among the obstacles of other worlds, one per flight, with the same goals, bounds and ground.

        Raises:
            ValueError: there is not one world per flight.
        """
        if len(worlds) != len(self._worlds):
            raise ValueError(f"{len(worlds)} worlds were given for {len(self._worlds)} flights; give one for each.")
        self._worlds = list(worlds)
        self.simulator.set_worlds(worlds)

    def _store(self, sweep: int) -> None:
        """Store a complete sweep in the cloud, and tell the planner how old the cloud is if sweeps are lost."""
        lidar = self.simulator.lidar
        self._observe()
        self.planner.store_sweep(sweep % self._rows, lidar.points, time=lidar.model.sweep_end(sweep))
        if lidar.model.sweep_loss > 0.0 or lidar.model.is_blind:
            is_lost = lidar.loses(sweep) | lidar.model.is_blind
            self._lost_sweeps = np.where(is_lost, self._lost_sweeps + 1, 0)
            self.planner.inputs.cloud_age.assign((self._lost_sweeps / lidar.model.sweep_rate).astype(np.float32))

    @exclusive
    def time_stages(self, ticks: int) -> dict[str, float]:
        """Fly some ticks and return the mean time of each stage of a tick [ms].

        "planner", "vehicle", "lidar" and "sweeps", which stores a complete sweep in the cloud, add up to the tick. The
        stages of the planner at the last of these ticks follow as "planner.partition" and so on.
        """
        self.simulator.timer = timer = StageTimer(self.simulator.device)
        for _ in range(ticks):
            self.step()
        self.simulator.timer = None
        stages = {name: total / ticks for name, total in timer.total_ms().items()}
        for name, times in self.planner.time_stages(_TIMED_PLANS).items():
            stages[f"planner.{name}"] = statistics.median(times)
        return stages

    @exclusive
    def run(self, *, progress: BatchProgress | None = None) -> list[FlightResult]:
        """Fly until all flights are over, or until Ctrl-C; unfinished flights then have the reason None.

        Args:
            progress: called repeatedly, and at the end.
        """
        ticks = _CUDA_TICKS_PER_CHECK if self.simulator.device.is_cuda else 1
        total = len(self._worlds)
        self.interrupted = False
        with deferred_interrupt() as is_interrupted:
            while True:
                finished = self._count_finished()
                if progress is not None:
                    progress(finished, total, self.simulator.time)
                if finished == total or is_interrupted():
                    break
                for _ in range(ticks):
                    self.step()
                self._collect_times()
            self.interrupted = is_interrupted()
        return self.results()

    @exclusive
    def results(self) -> list[FlightResult]:
        """Return the result of each flight so far."""
        self._collect_times()
        return flight_results(
            self.simulator.records(),
            self.simulator.outcomes(),
            self._worlds,
            self.simulator.vehicle.position.numpy(),
            rules=self.simulator.rules,
            seeds=self._seeds,
            configs=self._config_names,
            plan_ms=statistics.median(self._plan_ms) if self._plan_ms else None,
        )

    def close(self) -> None:
        """Stop the threads of the planner."""
        self.planner.close()

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
            inputs=[self.simulator.time, self.simulator.record, *state],
            outputs=outputs,
            device=self.simulator.device,
        )

    def _plan(self) -> None:
        if self.simulator.device.is_cuda:
            stream = self.simulator.device.stream
            started, ended = (wp.Event(self.simulator.device, enable_timing=True) for _ in range(2))
            stream.record_event(started)
            self.planner.launch(active=self.simulator.active)
            stream.record_event(ended)
            self._pending.append((started, ended))
        else:
            started = time.perf_counter()
            self.planner.launch(active=self.simulator.active)
            self._plan_ms.append(1e3 * (time.perf_counter() - started))

    def _collect_times(self) -> None:
        if self._pending:
            wp.synchronize_event(self._pending[-1][1])
            self._plan_ms += [wp.get_event_elapsed_time(*pair, synchronize=False) for pair in self._pending]
            self._pending.clear()
