"""Planner: owns the buffers and turns a state, a goal and a cloud into a Plan."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from aero_planner.arrays import fine_shape, input_block, output_block, work_arrays
from aero_planner.cloud import Cloud, Points
from aero_planner.config import PlannerConfig
from aero_planner.kernels.params import Params, pack
from aero_planner.pipeline import Pipeline
from aero_planner.plan import Goal, Plan, PlanStatus, VehicleState
from aero_planner.warp_init import quieten

__all__ = ["History", "Planner"]


@dataclass(frozen=True, eq=False)
class History:
    """What the planner carries from one plan to the next."""

    controls: NDArray[np.float32]
    """Previous controls to fly, shape [B, N, 4]."""
    end: NDArray[np.float32]
    """Where they led [m], shape [B, 3], world frame."""
    turn: NDArray[np.float32]
    """Where the way to the goal turned behind that [m], shape [B, 3]; NaN where it led straight on."""
    time: NDArray[np.float64]
    """When they were planned [s], shape [B]; NaN where there are none."""
    tick: NDArray[np.int32]
    """Number of plans so far, which picks the noise, shape [B]."""


class Planner:
    """The AERO-MPPI planner on one device.

    Args:
        config: parameters; `configure` changes them later.
        device: "cpu" or a CUDA device such as "cuda:0".
        seed: of the noise. Drone b of a batch draws what a single planner with seed + b draws.
        batch: None for one drone, or B drones that share every launch; arrays then have a leading axis B.
        threads: CPU threads for the heavy stages; None for one per core. The plan does not depend on it.

    Raises:
        ValueError: the device does not exist, config is not a PlannerConfig, or batch or threads is less than 1.
    """

    def __init__(
        self,
        config: PlannerConfig | None = None,
        *,
        device: str = "cpu",
        seed: int = 0,
        batch: int | None = None,
        threads: int | None = None,
    ) -> None:
        if batch is not None and batch < 1:
            raise ValueError(f"batch is {batch}; it must be None or at least 1.")
        if config is not None and not isinstance(config, PlannerConfig):
            raise ValueError(
                f"config is {config!r}; it must be a PlannerConfig, such as PlannerConfig.preset('paper')."
            )
        if threads is not None and threads < 1:
            raise ValueError(f"threads is {threads}; it must be None or at least 1.")
        self._device = _find_device(device)
        self._batched = batch is not None
        self._batch = batch or 1
        self._seed = int(seed)
        self._lanes = 1 if self._device.is_cuda else (threads or os.cpu_count() or 1)
        self._config = config or PlannerConfig()
        self._inputs = input_block(self._batch, self._device)
        self._set_input_defaults()
        self._cloud = Cloud(batch, self._device)
        self._params = wp.zeros(self._batch, dtype=Params, device=self._device)
        self._build()

    def _set_input_defaults(self) -> None:
        host = self._inputs.host()
        for name in ("time", "goal_velocity", "goal_quaternion"):
            host[name][:] = np.nan
        host["quaternion"][:] = (1.0, 0.0, 0.0, 0.0)
        host["ground_height"][:] = -np.inf
        self._inputs.upload()

    def _build(self) -> None:
        self._outputs = output_block(self._config, self._batch, self._device)
        self._work = work_arrays(self._config, self._batch, self._lanes, self._device)
        seeds = (self._seed % 2**32 + np.arange(self._batch, dtype=np.int64)).astype(np.int32)  # of any size
        self._work.seed.assign(seeds)
        self.reset()
        self._write_params()
        self._record()

    def _record(self) -> None:
        if hasattr(self, "_pipeline"):
            self._pipeline.close()
        self._pipeline = Pipeline(
            self._config, batch=self._batch, lanes=self._lanes, inputs=self._inputs.arrays,
            outputs=self._outputs.arrays, work=self._work, points=self._cloud.array, params=self._params,
        )  # fmt: skip

    def _write_params(self, records: NDArray[Any] | None = None) -> None:
        if records is None:
            records = np.repeat(pack(self._config)[None], self._batch)
        self._params.assign(records)

    @property
    def config(self) -> PlannerConfig:
        """The configuration in use."""
        return self._config

    @property
    def device(self) -> str:
        """Name of the device, such as "cpu"."""
        return str(self._device)

    @property
    def inputs(self) -> SimpleNamespace:
        """Device arrays read by `launch`: position, velocity, acceleration, goal_position, goal_velocity [B] vec3;
        quaternion, goal_quaternion [B] vec4, w x y z; time [B] float64 [s]; cloud_age [B] [s]; ground_height [B] [m],
        -inf where it is unknown; point_count [B]. NaN in goal_velocity, goal_quaternion or time means: derive it. The
        cloud is `points`."""
        return self._inputs.arrays

    @property
    def outputs(self) -> SimpleNamespace:
        """Device arrays written by `launch`, instances flattened where a name is singular; see
        `buffers.output_block`."""
        return self._outputs.arrays

    @property
    def points(self) -> wp.array:
        """Device array of the clouds, shape [B, P], vec3 [m], world frame; `reserve` makes room."""
        self._cloud.forget()
        return self._cloud.array

    @property
    def command(self) -> wp.array:
        """Device array of the controls to fly, shape [B, N], vec4 of F_t [N] and omega [rad/s]."""
        return self._work.previous_controls

    def configure(self, config: PlannerConfig | Sequence[PlannerConfig]) -> None:
        """Use another configuration from the next plan on.

        Live parameters are copied to the device and nothing else happens; a structural change rebuilds buffers and
        forgets the previous plan. A sequence of B configurations of equal structure gives each drone its own.

        Raises:
            ValueError: a sequence has the wrong length or differs in structure.
            MemoryError, RuntimeError: the device has no room for the new structure; the present one stays.
        """
        configs = [config] if isinstance(config, PlannerConfig) else list(config)
        if not isinstance(config, PlannerConfig) and len(configs) != self._batch:
            raise ValueError(
                f"{len(configs)} configurations were given for a batch of {self._batch}; give one for each."
            )
        if any(other.structure() != configs[0].structure() for other in configs):
            raise ValueError(
                "the configurations of one batch differ in structure; give them equal samples, steps and grids."
            )
        rebuild = configs[0].structure() != self._config.structure()
        before, self._config = self._config, configs[0]
        if rebuild:
            try:
                self._build()
            except Exception:
                self._config = before
                self._build()
                raise
        if not isinstance(config, PlannerConfig):
            self._write_params(np.array([pack(one) for one in configs]))
        elif not rebuild:
            self._write_params()

    def reserve(self, count: int) -> None:
        """Make room for `count` points per drone; the cloud is then all NaN, which means no points."""
        if self._cloud.reserve(count):
            self._record()
        self._inputs.host()["point_count"][:] = count
        self._inputs.upload()
        self._pipeline.limit_points(count)

    def upload(self, points: ArrayLike, *, first: int = 0) -> None:
        """Start copying points, such as a new sweep, to the device beside a plan that it computes.

        The next `launch`, or `plan` with `Planner.points`, takes them in, in the place of those from `first` on.

        Args:
            points: [m], shape [n, 3], a batch [B, n, 3], world frame.
            first: place of the first in the cloud that `reserve` has made room for.

        Raises:
            ValueError: the points have another shape, or there is no room.
        """
        self._cloud.send(points, first)

    def reset(self) -> None:
        """Forget the previous plan and start the noise anew."""
        self._work.tick.zero_()
        self._work.previous_controls.zero_()
        self._work.previous_time.fill_(np.nan)

    def history(self) -> History:
        """Return what the next plan builds on; `restore` with it makes the next plan repeatable bit for bit."""
        work = self._work
        arrays = (work.previous_controls, work.previous_end, work.previous_turn, work.previous_time, work.tick)
        return History(*(array.numpy().copy() for array in arrays))

    def restore(self, history: History) -> None:
        """Continue from `history`; one of another structure or batch is ignored and the planner is reset."""
        work = self._work
        if history.controls.shape != (*work.previous_controls.shape, 4):
            return self.reset()
        work.previous_controls.assign(history.controls)
        work.previous_end.assign(history.end)
        work.previous_turn.assign(history.turn)
        work.previous_time.assign(history.time)
        work.tick.assign(history.tick)

    def launch(self) -> None:
        """Plan from the device arrays of `inputs` and `points` into those of `outputs` and `command`.

        Nothing is copied to or from the host, and on CUDA the call returns before the plan is done.
        """
        self._cloud.receive()
        self._pipeline.run()

    def plan(
        self,
        state: VehicleState,
        goal: Goal,
        points: Points,
        *,
        cloud_age: float = 0.0,
        ground_height: ArrayLike | None = None,
        samples: bool = False,
    ) -> Plan:
        """Plan once.

        Args:
            state: of the drone, world frame.
            goal: where to fly, world frame.
            points: cloud [m], shape [P, 3], world frame; NumPy or Warp array; a batch takes [B, P, 3] or B arrays.
                Points that are not finite are dropped and counted. `Planner.points` is the cloud on the device, see
                `upload`.
            cloud_age: time since the cloud was measured [s]; beyond partition.cloud_age_max the drone brakes.
            ground_height: height of flat ground [m], world frame, which counts as an obstacle unless costs.use_ground
                is off; one number, or an array of shape [B] for a batch, -inf for a drone whose ground is unknown.
                None means unknown.
            samples: also return the Stage I rollouts.

        Returns:
            A plan with arrays of its own. Same seed, device, inputs and history: same plan, bit for bit.

        Raises:
            ValueError: an input has the wrong shape or is not finite; nothing was launched.
        """
        started = time.perf_counter()
        self._write_inputs(state, goal, cloud_age, ground_height)
        self._write_points(points)
        self._inputs.upload()
        uploaded = time.perf_counter()
        self.launch()
        raw = self._outputs.download()
        done = time.perf_counter()
        stage_ms = {"inputs": 1e3 * (uploaded - started)} | self._pipeline.stage_ms
        if self._device.is_cuda:
            stage_ms = {"inputs": stage_ms["inputs"], "graph": 1e3 * (done - uploaded)}
        stage_ms["total"] = 1e3 * (done - started)
        return self._to_plan(raw, stage_ms, samples)

    def _write_inputs(self, state: VehicleState, goal: Goal, cloud_age: float, ground_height: ArrayLike | None) -> None:
        batch = (self._batch,) if self._batched else ()
        values = {
            "position": _checked("state.position", state.position, (*batch, 3)),
            "velocity": _checked("state.velocity", state.velocity, (*batch, 3)),
            "quaternion": _checked("state.quaternion", state.quaternion, (*batch, 4)),
            "acceleration": _checked("state.acceleration", state.acceleration, (*batch, 3), missing=0.0),
            "time": _checked("state.time", state.time, batch, missing=np.nan),
            "goal_position": _checked("goal.position", goal.position, (*batch, 3)),
            "goal_velocity": _checked("goal.velocity", goal.velocity, (*batch, 3), missing=np.nan),
            "goal_quaternion": _checked("goal.quaternion", goal.quaternion, (*batch, 4), missing=np.nan),
            "cloud_age": _checked("cloud_age", cloud_age, (), limit=np.inf),
            "ground_height": _checked_ground(ground_height, batch),
        }
        for name, field in (("quaternion", "state.quaternion"), ("goal_quaternion", "goal.quaternion")):
            if (np.linalg.norm(values[name], axis=-1) < 1e-6).any():
                raise ValueError(f"{field} is zero; give a unit quaternion in the order w, x, y, z.")
        host = self._inputs.host()
        for name, value in values.items():
            host[name][:] = value

    def _write_points(self, points: Points) -> None:
        if points is self._cloud.array or self._cloud.knows(points):
            return
        clouds = self._cloud.split(points)
        counts = [len(cloud) for cloud in clouds]
        if max(counts) > self._cloud.capacity:
            # Room to grow, so that a cloud that gains a few points each sweep does not rebuild the graph each time.
            self.reserve(max(counts) * 5 // 4)
        self._cloud.write(clouds, points)
        self._inputs.host()["point_count"][:] = counts
        self._pipeline.limit_points(max(counts))

    def _to_plan(self, raw: dict[str, NDArray[Any]], stage_ms: dict[str, float], samples: bool) -> Plan:
        B, config = self._batch, self._config
        part, M = config.partition, len(config.kinds)
        coarse = (B, part.coarse_rows, part.coarse_columns)
        fine = (B, *fine_shape(config))
        filtered = [raw["filtered"][b][raw["occupied"][b] != 0] for b in range(B)]
        dropped = raw["dropped"]
        kinds = list(config.kinds)
        if not self._batched and raw["braked"][0] >= 0:
            kinds[raw["braked"][0]] = "brake"

        def field(name: str) -> Any:
            return raw[name] if self._batched else raw[name][0]

        def shaped(name: str, shape: tuple[int, ...]) -> Any:
            array = raw[name].reshape(shape)
            return array if self._batched else array[0]

        def instances(name: str) -> Any:
            array = raw[name][:, :M]  # the last is the plain brake
            return array if self._batched else array[0]

        return Plan(
            fine_range=shaped("fine_range", fine),
            safe_range=shaped("safe_range", coarse),
            safe_direction=shaped("safe_direction", (*coarse, 3)),
            filtered_points=filtered if self._batched else filtered[0],
            initial_endpoints=instances("initial_endpoint"),
            anchors=instances("anchor"),
            guide_coefficients=np.swapaxes(instances("coefficient"), -1, -2),
            guides=instances("guide"),
            kinds=tuple(kinds),
            controls=instances("controls"),
            positions=instances("positions"),
            velocities=instances("velocities"),
            quaternions=instances("quaternions"),
            stage1_cost=shaped("cost", (B, M, -1))[..., : config.sampling.samples],
            stage2_cost=instances("S2"),
            goal_cost=instances("J_goal"),
            collision_cost=instances("J_col"),
            clearance=instances("clearance"),
            best=raw["best"] if self._batched else int(raw["best"][0]),
            status=raw["status"] if self._batched else PlanStatus(int(raw["status"][0])),
            dropped_points=dropped if self._batched else int(dropped[0]),
            stage_ms=stage_ms,
            samples=self._samples(raw["positions"][:, :M]) if samples else None,
        )

    def _samples(self, positions: NDArray[np.float32]) -> NDArray[np.float32]:
        B, M, rows, _ = positions.shape
        after = self._work.sample_positions.numpy()[:, : rows - 1, :, : self._config.sampling.samples]
        after = after.transpose(0, 3, 1, 2)
        after = after.reshape(B, M, -1, rows - 1, 3)
        start = np.broadcast_to(positions[:, :, None, :1], (*after.shape[:3], 1, 3))
        rollouts = np.concatenate((start, after), axis=3)
        return rollouts if self._batched else rollouts[0]

    def close(self) -> None:
        """Let the worker threads end; the planner can't be used afterwards."""
        self._pipeline.close()


def _find_device(name: str) -> wp.Device:
    quieten()  # what Warp reports on stdout would mix with the caller's own output
    try:
        return wp.get_device(name)
    except Exception as error:
        known = ", ".join(str(device) for device in wp.get_devices())
        raise ValueError(f"device {name!r} is not available: {error}; this machine has {known}.") from error


def _checked_ground(height: ArrayLike | None, batch: tuple[int, ...]) -> NDArray[np.float64]:
    """Return ground heights [m] as float64 of shape [] or [B], -inf where they are unknown."""
    if height is None:
        return np.full(batch, -np.inf)
    shape = () if np.ndim(height) == 0 else batch
    array = np.asarray(height)
    unknown = array == -np.inf if array.dtype.kind == "f" else np.zeros(array.shape, dtype=bool)
    return np.where(unknown, -np.inf, _checked("ground_height", np.where(unknown, 0.0, array), shape))


def _checked(
    name: str, value: Any, shape: tuple[int, ...], *, missing: float | None = None, limit: float = 1e6
) -> NDArray[np.float64]:
    """Return `value` as float64 of `shape`; `missing` stands for None. Raises ValueError when it does not fit."""
    if value is None and missing is not None:
        return np.full(shape, missing)
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} is {value!r}; it must be numbers of shape {shape}.") from error
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}; it must have shape {shape}.")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} is {array.tolist()}; every value must be finite.")
    if name != "state.time" and (np.abs(array) > limit).any():
        raise ValueError(f"{name} is {array.tolist()}; values beyond {limit:g} have no precision left in float32: "
                         "move the origin of the world nearer.")  # fmt: skip
    return array
