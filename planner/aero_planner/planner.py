"""The planner: owns the device arrays and turns a state, a goal and a cloud into a plan."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, cast, overload

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from aero_planner.array_memory import PackedArrays, as_dict
from aero_planner.arrays import CloudArrays, PlannerInputs, PlannerOutputs, Workspace
from aero_planner.cloud import Cloud, Points
from aero_planner.config import PlannerConfig
from aero_planner.cost_terms import CostTerms, evaluate_controls, evaluate_terms
from aero_planner.device.kernel_tuning import CPU, CUDA
from aero_planner.device.params import Params, pack
from aero_planner.exclusive import Use, exclusive
from aero_planner.history import History, kept_arrays
from aero_planner.launch_sequence import PLAN, usable_cores
from aero_planner.pipeline import ARRIVAL, PLAN_AND_ARRIVAL, Pipeline
from aero_planner.plan import BatchPlan, Goal, Plan, PlanArrays, VehicleState
from aero_planner.plan_inputs import check_configs, check_inputs
from aero_planner.plan_outputs import make_plan, sampled_positions
from aero_planner.recorder import PlannerArrays, Recorder
from aero_planner.safety import Safety, judge_instances
from aero_planner.seeds import Seeds, seeds_of_batch
from aero_planner.structure import Structure
from aero_planner.sweep_memory import SweepMemory
from aero_planner.sweeps import Sweeps, shows_something
from aero_planner.warp_init import find_device

if TYPE_CHECKING:
    from typing_extensions import TypeVar

    _Plan = TypeVar("_Plan", bound=PlanArrays, default=Plan, covariant=True)
else:
    from typing import TypeVar

    _Plan = TypeVar("_Plan")

_LOOKED_AT = 64
"""Number of points of a cloud on the device that are looked at first."""
_MIN_SWEEPS = 16
"""Sweeps for which there is room at least."""


class Planner(Generic[_Plan]):
    """The AERO-MPPI planner on one device. One thread at a time may use it: another one gets a RuntimeError.

    Args:
        config: parameters; `configure` changes them later. None means the default.
        device: "cpu" or a CUDA device such as "cuda:0".
        seed: seed of the noise. Drone b of a batch draws the noise of a single planner with seed + b, or with the b-th
            seed if a sequence of B seeds is given.
        batch: None for one drone, or B drones that share every launch; arrays then have a leading axis B.
        threads: CPU threads for the heavy stages; None for one per core that this process may use. The plan does not
            depend on it.

    Raises:
        ValueError: the device does not exist, config is not a PlannerConfig, batch or threads is less than 1, or the
            number of seeds is not that of drones, or one is not a whole number.
    """

    @overload
    def __init__(
        self: Planner[Plan],
        config: PlannerConfig | None = None,
        *,
        device: str = "cpu",
        seed: Seeds = 0,
        batch: None = None,
        threads: int | None = None,
    ) -> None: ...

    @overload
    def __init__(
        self: Planner[BatchPlan],
        config: PlannerConfig | None = None,
        *,
        device: str = "cpu",
        seed: Seeds = 0,
        batch: int,
        threads: int | None = None,
    ) -> None: ...

    def __init__(
        self,
        config: PlannerConfig | None = None,
        *,
        device: str = "cpu",
        seed: Seeds = 0,
        batch: int | None = None,
        threads: int | None = None,
    ) -> None:
        for name, count in (("batch", batch), ("threads", threads)):
            if count is not None and not (isinstance(count, int | np.integer) and count >= 1):
                raise ValueError(f"{name} is {count!r}; it must be None or a whole number of at least 1.")
        seeds = seeds_of_batch(seed, batch or 1)
        if len(seeds) != (batch or 1):
            raise ValueError(f"{len(seeds)} seeds were given for {batch or 1} drones; give one for each or an integer.")
        if config is not None:
            check_configs([config], 1)
        self._use = Use("planner")
        self._device = find_device(device)
        self._tuning = CPU if self._device.is_cpu else CUDA
        self._batched = batch is not None
        self._batch = batch or 1
        self._seeds = seeds
        self._workers = 1 if self._device.is_cuda else (threads or usable_cores())
        self._config = config or PlannerConfig()
        self._memory: SweepMemory | None = None
        self._structure = self._make_structure()
        self._assign_seeds()
        self._inputs = PackedArrays(PlannerInputs, self._structure.sizes, self._device)
        self._set_input_defaults()
        self._cloud = Cloud(batch, self._inputs.arrays.point_count)
        self._scanned = self._cloud.arrays
        self._params = wp.zeros(self._batch, dtype=Params, device=self._device)
        self._write_params([self._config])
        self._pipeline = self._make_pipeline()

    def _set_input_defaults(self) -> None:
        host = self._inputs.host()
        for name in ("time", "acceleration", "disturbance", "goal_velocity", "goal_quaternion"):
            host[name][:] = np.nan
        host["quaternion"][:] = (1.0, 0.0, 0.0, 0.0)
        host["ground_height"][:] = -np.inf
        self._inputs.upload()

    def _make_structure(self) -> Structure:
        return Structure.allocate(
            self._config, self._device, batch=self._batch, workers=self._workers, tuning=self._tuning
        )

    def _assign_seeds(self) -> None:
        # Seeds may be of any size.
        seeds = np.array([seed % 2**32 for seed in self._seeds], dtype=np.int64).astype(np.int32)
        self._structure.work.seed.assign(seeds)

    def _arrays(self) -> PlannerArrays:
        own = self._structure
        change = self._memory.change if self._memory is not None and self._scanned is self._memory.arrays else None
        return PlannerArrays(
            self._inputs.arrays, own.outputs.arrays, own.work, own.stages, self._scanned, change, self._params
        )

    def _make_pipeline(self) -> Pipeline:
        own = self._structure
        return Pipeline(self._config, own.composition, own.sizes, self._tuning, self._arrays())

    def _scan(self, cloud: CloudArrays) -> None:
        """Plan from this cloud from now on."""
        if cloud is not self._scanned:
            self._scanned = cloud
            self._forget_sweeps()
            self._replace_pipeline()

    def _forget_sweeps(self) -> None:
        """Forget what is known from the sweeps so far, such as the tracks of dynamic obstacles."""
        self._structure.forget("sweeps")
        if self._memory is not None:
            self._memory.forget_motion()

    def _replace_pipeline(self) -> None:
        """Record the launches again, after arrays were replaced."""
        self._pipeline.close()
        self._pipeline = self._make_pipeline()

    def _write_params(self, configs: Sequence[PlannerConfig]) -> None:
        """Write the live parameters of one configuration for all drones, or of one for each."""
        records = np.array([pack(config) for config in configs])
        self._params.assign(np.repeat(records, self._batch // len(records)))

    @property
    def config(self) -> PlannerConfig:
        """Configuration in use; the first drone's if they differ."""
        return self._config

    @property
    def device(self) -> str:
        """Name of the device, such as "cpu"."""
        return str(self._device)

    @property
    def inputs(self) -> PlannerInputs:
        """Device arrays that `launch` reads. The cloud is `points`."""
        return self._inputs.arrays

    @property
    def outputs(self) -> PlannerOutputs:
        """Device arrays that `launch` writes."""
        return self._structure.outputs.arrays

    @property
    def workspace(self) -> Workspace:
        """Device arrays of intermediate results, for tests and benchmarks; a structural change replaces them."""
        return self._structure.work

    def arrays_of(self, stage: str) -> dict[str, wp.array]:
        """Return the device arrays of an active stage by name, for tests and benchmarks.

        Raises:
            ValueError: there is no such stage, or it is not active.
        """
        active = self._structure.stages
        if stage not in active:
            raise ValueError(f"stage {stage!r} is not active; stages.active lists {', '.join(active) or 'none'}.")
        groups = [group for group in active[stage] if group is not None]
        return {name: array for group in groups for name, array in as_dict(group).items()}

    @property
    def params(self) -> wp.array:
        """Device array of the live parameters, shape [B]."""
        return self._params

    @property
    def points(self) -> wp.array:
        """Device array of the clouds, shape [B, P], vec3 [m], world frame; `reserve` makes room."""
        self._cloud.invalidate()
        return self._cloud.array

    @property
    def command(self) -> wp.array:
        """Device array of the controls to fly, shape [B, N], vec4 of F_t [N] and omega [rad/s]."""
        return self._structure.work.previous_controls

    @exclusive
    def configure(self, config: PlannerConfig | Sequence[PlannerConfig]) -> None:
        """Use another configuration from the next plan on.

        A change of live parameters only copies them to the device. A structural change rebuilds the arrays and discards
        the previous plan. A sequence of B configurations of equal structure gives each drone its own.

        Raises:
            ValueError: config is not a PlannerConfig, or a sequence has the wrong length or configurations that differ
                in structure.
            MemoryError, RuntimeError: the device has no room for the new structure; the present one stays.
        """
        configs = check_configs(config, self._batch)
        before, self._config = self._config, configs[0]
        if configs[0].structure() != before.structure():
            present = self._structure
            try:
                self._structure = self._make_structure()
                self._assign_seeds()
                self._replace_pipeline()
            except Exception:
                self._config, self._structure = before, present
                self._replace_pipeline()
                raise
            self._forget_sweeps()
        self._write_params(configs)
        shown, shown_before = ((config.partition, *config.stage_sections) for config in (configs[0], before))
        if shown != shown_before:
            self._forget_sweeps()  # they may show something else by other parameters

    @exclusive
    def reserve(self, count: int) -> None:
        """Make room for `count` points per drone. The cloud is then all NaN, which means no points."""
        self._cloud.reserve(count)
        self._inputs.host()["point_count"][:] = count
        self._inputs.upload()
        self._scan(self._cloud.arrays)

    @exclusive
    def reserve_sweeps(
        self, sweeps: int, points: int, *, whole: int | None = None, remembered: Sequence[int] | None = None
    ) -> None:
        """Make room for sweeps with `points` points per drone in all, and plan from them. There are none yet.

        Sweeps that `store_sweep` stores in turn are thinned when `whole` newer ones follow, see `Sweeps`. Each drone
        forgets those before its newest `remembered` ones; None forgets none.
        """
        self._memory = SweepMemory(
            self._device, self._batch, sweeps=sweeps, points=points, whole=whole, remembered=remembered
        )
        self._scan(self._memory.arrays)

    @exclusive
    def store_sweep(self, index: int, points: wp.array, *, time: float | None = None) -> None:
        """Replace a sweep of each drone by points on the device; nothing is copied to or from the host.

        Args:
            index: which of the sweeps; all have the same size. Of points at the same range, that of the first sweep
                is kept.
            points: vec3 [B, n] [m], world frame; NaN for rays without return.
            time: when the sweep was complete [s], at the position of `inputs`; None is the time of `inputs`. Sweeps
                that are stored in turn show dynamic obstacles.

        Raises:
            ValueError: there is no room for the sweep, see `reserve_sweeps`.
        """
        if self._memory is None or self._scanned is not self._memory.arrays:
            raise ValueError("there is no room for sweeps; call `reserve_sweeps` first.")
        self._memory.store(index, points, self._arrive, time=time)

    @exclusive
    def reset(self, *, seed: int | None = None) -> None:
        """Discard the previous plan and restart the noise sequence, with another `seed` if one is given."""
        if seed is not None:
            self._seeds = seeds_of_batch(seed, len(self._seeds))
            self._assign_seeds()
        self._structure.forget("plans")

    @exclusive
    def history(self) -> History:
        """Return the state that the next plan builds on; `restore` makes that plan repeatable bit for bit."""
        return History.of(self._structure.groups)

    @exclusive
    def restore(self, history: History) -> None:
        """Continue from `history`. If it has another structure or batch, the planner is reset instead."""
        if not history.write_to(self._structure.groups):
            self.reset()

    @exclusive
    def launch(self, *, active: wp.array | None = None) -> None:
        """Plan from the device arrays of `inputs` and `points` into those of `outputs` and `command`.

        Nothing is copied to or from the host, and on CUDA the call returns before the plan is finished.

        Args:
            active: mask, int [B] on the device: drones with 0 are left out of this plan, to save its time. What
                `outputs` and `command` hold for them means nothing. None plans for all drones.
        """
        if active is None:
            self._pipeline.run()
            return
        wp.copy(self._structure.work.active, active)
        self._pipeline.run()
        self._structure.work.active.fill_(1)

    def _arrive(self) -> None:
        """Run the launches of a sweep that arrives."""
        self._pipeline.run(ARRIVAL)

    @exclusive
    def plan(
        self,
        state: VehicleState,
        goal: Goal,
        points: Points | Sweeps,
        *,
        cloud_age: float = 0.0,
        empty_is_clear: bool = False,
        ground_height: ArrayLike | None = None,
        samples: bool = False,
    ) -> _Plan:
        """Plan once.

        Args:
            state: state of the drone, world frame.
            goal: state at the goal, world frame.
            points: cloud [m], shape [P, 3], world frame, a NumPy or Warp array; for a batch [B, P, 3] or B arrays.
                Points that are not finite are dropped and counted. `Planner.points` plans from the cloud on the device.
                `Sweeps` are fastest for one drone: only those that have arrived since the last plan are copied.
            cloud_age: time since the cloud was measured [s]; beyond partition.cloud_age_max the drone brakes.
            empty_is_clear: True if a cloud without finite points beyond partition.range_min means that nothing is in
                range of the sensor. Otherwise the drone brakes, too, if clouds or newest sweeps have been without for
                as long. It also brakes if most points are farther than `sweeps.FARTHEST_RETURN`, as in millimetres.
            ground_height: height of flat ground [m], world frame, which counts as an obstacle unless costs.use_ground
                is off: a number, or an array of shape [B] for a batch, -inf where it is unknown. None means unknown.
            samples: return the Stage I rollouts as well.

        Returns:
            A plan, with a batch a `BatchPlan`. Same seed, device, inputs and history: same plan, bit for bit.

        Raises:
            ValueError: an input has the wrong type or shape or is not finite; nothing was launched.
            RuntimeError: another thread is using the planner, or it is closed.
        """
        started, own = time.perf_counter(), self._structure
        if self._batched and isinstance(points, Sweeps):
            raise ValueError("sweeps were given for a batch; give a joined cloud for each drone, or use `store_sweep`.")
        checked = check_inputs(state, goal, cloud_age, ground_height, (self._batch,) if self._batched else ())
        host = self._inputs.host()
        for name, value in checked.items():
            host[name][:] = value
        stages = PLAN
        newest = [points.newest] if isinstance(points, Sweeps) else self._cloud.split(points)
        positions = np.reshape(checked["position"], (-1, 3))
        nearest = self._config.partition.range_min
        host["is_blind"][:] = [
            not _shows(cloud, position, nearest=nearest, empty=empty_is_clear)
            for cloud, position in zip(newest, positions, strict=True)
        ]
        if isinstance(points, Sweeps):
            self._inputs.upload()
            stages = self._write_sweeps(points)
        else:
            self._write_points(points, newest)
            self._inputs.upload()
        uploaded = time.perf_counter()
        self._pipeline.run(stages)
        own.outputs.start_download()
        values = own.outputs.finish_download()
        done = time.perf_counter()
        stage_ms = {"inputs": 1e3 * (uploaded - started)}
        stage_ms |= {"graph": 1e3 * (done - uploaded)} if self._device.is_cuda else self._pipeline.stage_ms
        stage_ms["total"] = 1e3 * (done - started)
        sampled = sampled_positions(own.work, own.sizes, values["positions"]) if samples else None
        plan = make_plan(
            values, self._config, own.composition.stages, batched=self._batched, stage_ms=stage_ms, samples=sampled
        )
        return cast(_Plan, plan)

    def _write_points(self, points: Points, clouds: list[Any]) -> None:
        if not self._cloud.is_current(points):
            self._inputs.host()["point_count"][:] = self._cloud.write(points, clouds)
        self._scan(self._cloud.arrays)

    def _write_sweeps(self, sweeps: Sweeps) -> str:
        """Plan from these sweeps, and return the name of the stages to run."""
        if self._memory is None or not self._memory.has_room(sweeps):
            largest = max(map(len, sweeps), default=0)
            self.reserve_sweeps(max(len(sweeps), _MIN_SWEEPS), (sweeps.point_count + 2 * largest) * 5 // 4)
        assert self._memory is not None
        self._scan(self._memory.arrays)
        self._memory.hold(sweeps, self._arrive)
        if not sweeps:
            self._forget_sweeps()
        return PLAN_AND_ARRIVAL if self._memory.take_change() else PLAN

    @exclusive
    def cost_terms(self, instances: Sequence[int] = (), samples: Sequence[tuple[int, int]] = ()) -> CostTerms:
        """Return the costs of rollouts of the last plan term by term: the functions whose sums the planner has used.

        With a batch they are those of the first drone. The planner must have planned, and nothing may have changed it
        since.

        Args:
            instances: instances, for their Stage II rollouts; of one that was replaced, that of its replacement.
            samples: instance and sample of Stage I rollouts, which follow those.

        Raises:
            ValueError: there is no such instance or sample.
        """
        return evaluate_terms(self._recorder(), instances, samples)

    @exclusive
    def costs_of(self, controls: ArrayLike) -> CostTerms:
        """Return the costs of other controls from the start of the last plan, with its configuration; see `cost_terms`.

        Tracking, which is no part of S2, is that of the guide of instance 0.

        Args:
            controls: controls of the vehicle model, shape [n, N, 4].

        Raises:
            ValueError: they have another shape.
        """
        controls, steps = np.asarray(controls, dtype=np.float32), self._structure.sizes.N
        if controls.ndim != 3 or controls.shape[1:] != (steps, 4):
            raise ValueError(f"controls have the shape {list(controls.shape)}; give [n, {steps}, 4].")
        return evaluate_controls(self._recorder(), [(0, 0)] * len(controls), controls)

    @exclusive
    def safety(self) -> Safety:
        """Return how the selection has judged the instances of the last plan, by its own functions.

        With a batch they are those of the first drone. The planner must have planned, and nothing may have changed it
        since.
        """
        return judge_instances(self._recorder())

    def _recorder(self) -> Recorder:
        """Return the arrays as kernels take them, for launches that are not part of a plan."""
        own = self._structure
        return Recorder(
            lambda *_, **__: lambda: None, self._config, own.composition, own.sizes, self._tuning, self._arrays()
        )

    @exclusive
    def time_stages(self, repeat: int) -> dict[str, list[float]]:
        """Return the time of each stage in `repeat` plans from the device arrays [ms]; the next plan is unaffected.

        On CUDA the stages run one after another here, with an event between them.
        """
        history = self.history()
        times = self._pipeline.time_stages(repeat)
        self.restore(history)
        return times

    @exclusive
    def save_graph(self, path: str | os.PathLike[str]) -> Path:
        """Save the launches of a plan for the C++ host; kernels are written to a folder next to the file.

        Arrays are bound by their names in `PlannerInputs` and `PlannerOutputs`, and "points", "params", "seed", and
        those of the `History`. The planner must have planned before and, on the CPU, have one thread.

        Returns:
            The file, with the suffix ".wrp".
        """
        inputs = as_dict(self.inputs) | {
            "points": self.points,
            "params": self.params,
            "seed": self._structure.work.seed,
        }
        inputs |= kept_arrays(self._structure.groups)
        graph = self._pipeline.capture_graph()
        wp.capture_save(graph, os.fspath(path), inputs=inputs, outputs=as_dict(self.outputs))
        return Path(path).with_suffix(".wrp")

    def close(self) -> None:
        """Stop the worker threads, after the plan of another thread; other calls raise a RuntimeError from now on."""
        self._use.end()
        self._pipeline.close()


def _shows(cloud: Any, position: NDArray[np.float64], *, nearest: float, empty: bool) -> bool:
    """Return `shows_something` of a cloud that may be on the device."""
    if isinstance(cloud, wp.array):
        few = cloud[:_LOOKED_AT] if len(cloud) > _LOOKED_AT else cloud
        if shows_something(few.numpy(), position, nearest=nearest):
            return True
        cloud = cloud.numpy()
    return shows_something(cloud, position, nearest=nearest, empty=empty)
