"""One closed-loop flight as a source for the engine: the dashboard's drone."""

from __future__ import annotations

import dataclasses
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from aero_planner import Goal, Plan, PlannerConfig, VehicleState
from aero_viz.errors import UserError
from aero_viz.flight.batch import SWEEPS
from aero_viz.flight.estimate import StateNoise
from aero_viz.flight.explanation import explain, goal_problem
from aero_viz.flight.metrics import FlightResult, flight_results
from aero_viz.flight.rules import FlightRules
from aero_viz.flight.simulator import Simulator
from aero_viz.flight.vehicle import VehicleModel
from aero_viz.scenes.world import World
from aero_viz.sensors.lidar import LidarModel, livox_mid360
from aero_viz.session.source import Observation, SourceInfo

__all__ = ["KEPT_BYTES", "FlightSource"]

Cloud = NDArray[np.float32]
Pose = NDArray[np.float32]

KEPT_BYTES = 32_000_000
"""Sweeps up to this size are kept, the newest: what a checkpoint needs beyond them is measured again."""


@dataclass(frozen=True, eq=False, slots=True)
class _Scan:
    """What the points first .. end - 1 of a sweep follow from; together with the seed it repeats them bit for bit."""

    sweep: int
    first: int
    end: int
    before: Pose
    """True and believed pose at the beginning: position [m] and quaternion w, x, y, z, float32 [2, 7]."""
    after: Pose
    """.. and at the end."""


@dataclass(eq=False, slots=True)
class _Sweep:
    """One whole sweep."""

    scans: tuple[_Scan, ...]
    points: Cloud | None
    """Its returns [m], world frame; None once they are forgotten."""


@dataclass(frozen=True, eq=False, slots=True)
class _Checkpoint:
    tick: int
    state: bytes
    """The simulator's arrays, one after the other."""
    sweeps: tuple[_Sweep, ...]
    scans: tuple[_Scan, ...]
    """Of the sweep in progress."""
    goal: NDArray[np.float64]


class FlightSource:
    """A simulated flight in a world; implements `aero_viz.session.source.Source`.

    Checkpoints take about a kilobyte each: they hold no points, but the poses from which the points are measured again.

    Args:
        world: where to fly.
        lidar: None is the Livox Mid-360.
        vehicle: None is the default vehicle.
        rules: when the flight ends; a tick of the source is the time of one plan, `ticks_per_plan` ticks of the rules.
        noise: of the state estimate; None shows the planner the true state.
        control_step: dt of the plans' controls, which are interpolated where a plan is flown for several ticks [s].
        seed: of the LiDAR's pattern and of all noise; same seed, device and plans: same flight, bit for bit.
        device: Warp device.

    Raises:
        UserError: the tick does not divide the LiDAR's sweep.
    """

    def __init__(
        self,
        world: World,
        *,
        lidar: LidarModel | None = None,
        vehicle: VehicleModel | None = None,
        rules: FlightRules | None = None,
        noise: StateNoise | None = None,
        control_step: float = 0.05,
        seed: int = 0,
        device: str = "cpu",
    ) -> None:
        rules = rules or FlightRules()
        try:
            self._simulator = Simulator(
                [world],
                lidar=lidar or livox_mid360(),
                vehicle=vehicle or VehicleModel.from_config(PlannerConfig()),
                rules=rules,
                seeds=[seed],
                device=device,
                noise=noise,
            )
        except ValueError as error:
            raise UserError(f"Cannot fly {world.name!r}: {error}") from error
        self.info = SourceInfo(
            name=world.name,
            closed_loop=True,
            period=rules.period * rules.ticks_per_plan,
            start=world.start,
            world=world,
            settings=_settings(self._simulator),
        )
        self._phases = [k * rules.period / control_step for k in range(int(rules.ticks_per_plan))]
        self._world, self._seed, self._goal = world, seed, world.goal
        with wp.ScopedDevice(self._simulator.device):
            self._looking = wp.zeros(1, dtype=int)
            self._poses = [(wp.zeros(1, dtype=wp.vec3), wp.zeros(1, dtype=wp.vec4)) for _ in range(4)]
        self._kept: deque[_Sweep] = deque()
        self._kept_bytes = 0
        self._scans: tuple[_Scan, ...] = ()  # of the sweep in progress
        self._parts: list[Cloud] = []  # and what they measured
        self._read_state()
        size = self._simulator.lidar.model.points_per_sweep
        looks = [_Scan(sweep, 0, size, self._pose, self._pose) for sweep in range(-SWEEPS, 0)]
        self._show(tuple(_Sweep((look,), None) for look in looks))

    @property
    def simulator(self) -> Simulator:
        """The simulator behind the source."""
        return self._simulator

    @property
    def explanation(self) -> str | None:
        """In one sentence what ended the flight; None while it goes on and for an arrival."""
        return None if self.outcome is None else self._explain()

    def observe(self) -> Observation:
        """Return what the planner sees now, the estimated state and the last 10 whole sweeps, and the true state."""
        if self._observation is None:
            self._observation = Observation(
                time=self._simulator.time,
                state=self._state,
                goal=Goal(self._goal),
                points=self._points,
                sweep_count=len(self._sweeps),
                ground_height=self._world.ground_height,
                true_state=self._true_state,
            )
        return self._observation

    def advance(self, plan: Plan) -> None:
        """Fly the first controls of `plan` for the time of one plan; does nothing when the flight is over."""
        commands = wp.array(plan.command[None], dtype=wp.vec4, device=self._simulator.device)
        for phase in self._phases:
            if self.outcome is not None:
                return
            before = self._pose
            sweep, first, end = self._simulator.advance(commands, phase=phase)
            self._read_state()
            if self.outcome is None:  # a flight that has ended measures nothing
                self._scans = (*self._scans, _Scan(sweep, first, end, before, self._pose))
                self._parts.append(self._new_points(first, end))
            if end == self._simulator.lidar.model.points_per_sweep and self._scans:
                whole = _Sweep(self._scans, _returns(self._parts))
                self._scans, self._parts = (), []
                self._keep(whole)
                self._show((*self._sweeps[1:], whole))

    def checkpoint(self) -> object:
        """Return all that `restore` needs: about a kilobyte, and nothing that grows with the cloud."""
        tick, arrays = self._simulator.checkpoint()
        state = b"".join([array.tobytes() for array in arrays])
        return _Checkpoint(tick, state, self._sweeps, self._scans, self._goal)

    def restore(self, checkpoint: object) -> None:
        """Continue from a checkpoint of this source: the same plans give the same flight, bit for bit.

        Takes a few milliseconds within the last sweeps flown or restored, see `KEPT_BYTES`, else as long as measuring
        ten sweeps.

        Raises:
            TypeError: this is no checkpoint of a flight.
        """
        if not isinstance(checkpoint, _Checkpoint):
            raise TypeError(f"{type(checkpoint).__name__} is no checkpoint of a flight.")
        values, start = [], 0
        for like in self._simulator.checkpoint()[1]:
            values.append(np.frombuffer(checkpoint.state, like.dtype, like.size, start).reshape(like.shape))
            start += like.nbytes
        self._simulator.restore((checkpoint.tick, values))
        self._goal, self._scans = checkpoint.goal, checkpoint.scans
        self._parts = [self._measure(scan) for scan in self._scans]
        self._show(checkpoint.sweeps)
        self._read_state()

    def seek(self, time: float) -> None:
        """A flight cannot be sought, only restored.

        Raises:
            TypeError: always.
        """
        raise TypeError("a flight has no time line to seek in; restore one of its checkpoints.")

    def set_goal(self, position: ArrayLike) -> None:
        """Move the goal to `position` [m], shape [3], world frame; a flight that arrived, stalled or ran out of
        time goes on.

        Raises:
            UserError: the position is not three finite numbers, lies inside an obstacle, below the ground or outside
                the world's bounds; the goal stays.
        """
        goal = np.array(position, dtype=np.float64)
        if goal.shape != (3,) or not np.isfinite(goal).all():
            raise UserError(f"The goal {np.asarray(position).tolist()} is no position; give three finite numbers.")
        if problem := goal_problem(self._world, goal):
            raise UserError(f"{problem}; the goal before stays: give a free place.")
        goal.flags.writeable = False
        self._goal = goal
        self._simulator.set_goal(goal[None])
        self._read_state()

    def result(self) -> FlightResult:
        """Return the metrics of the flight so far."""
        return flight_results(
            self._simulator.records(),
            [self.outcome],
            period=self._simulator.rules.period,
            seeds=[self._seed],
            scenes=[self.info.name],
            configs=[""],
            plan_ms=None,
            explanations=[self._explain()],
        )[0]

    def close(self) -> None:
        """Nothing to release: device memory goes with the source."""

    def _explain(self) -> str | None:
        simulator, record = self._simulator, self._simulator.records()[0]
        return explain(
            self.outcome,
            self._world,
            simulator.vehicle.position.numpy()[0],
            time=float(record["ticks"]) * simulator.rules.period,
            clearance=float(record["clearance_min"]),
            goal=self._goal,
            rules=simulator.rules,
        )

    def _read_state(self) -> None:
        """Read the vehicle's true and believed state from the device."""
        vehicle, estimate = self._simulator.vehicle, self._simulator.estimate
        acceleration, time = vehicle.acceleration.numpy()[0].astype(np.float64), self._simulator.time

        def state_of(holder: Any) -> tuple[VehicleState, Pose]:
            arrays = [array.numpy()[0] for array in (holder.position, holder.velocity, holder.quaternion)]
            values = [array.astype(np.float64) for array in arrays]
            return VehicleState(*values, acceleration=acceleration, time=time), np.concatenate((arrays[0], arrays[2]))

        self._true_state, true_pose = state_of(vehicle)
        exact = estimate.position is vehicle.position
        self._state, pose = (self._true_state, true_pose) if exact else state_of(estimate)
        self._pose: Pose = np.stack((true_pose, pose))
        self.outcome: str | None = self._simulator.outcomes()[0]
        self._observation: Observation | None = None

    def _new_points(self, first: int, end: int) -> Cloud:
        points: Any = self._simulator.lidar.points.numpy()
        return points[0, first:end].copy()

    def _measure(self, scan: _Scan) -> Cloud:
        """Measure what was measured once, rays without return included."""
        for (place, attitude), pose in zip(self._poses, (*scan.before, *scan.after), strict=True):
            place.assign(pose[None, :3])
            attitude.assign(pose[None, 3:])
        before, believed_before, after, believed = self._poses
        self._simulator.lidar.scan(
            scan.sweep,
            scan.first,
            scan.end,
            poses=after,
            poses_before=before,
            finished=self._looking,
            estimated_poses=believed,
            estimated_poses_before=believed_before,
        )
        return self._new_points(scan.first, scan.end)

    def _show(self, sweeps: tuple[_Sweep, ...]) -> None:
        self._sweeps = sweeps
        self._points = np.concatenate([self._cloud(sweep) for sweep in sweeps])
        self._points.flags.writeable = False
        self._observation = None

    def _cloud(self, sweep: _Sweep) -> Cloud:
        if sweep.points is None:
            sweep.points = _returns([self._measure(scan) for scan in sweep.scans])
            self._keep(sweep)
        return sweep.points

    def _keep(self, sweep: _Sweep) -> None:
        """Remember the sweep's points, and forget those of the sweeps that were remembered longest ago."""
        assert sweep.points is not None
        self._kept.append(sweep)
        self._kept_bytes += sweep.points.nbytes
        while self._kept_bytes > KEPT_BYTES and len(self._kept) > SWEEPS:
            oldest = self._kept.popleft()
            assert oldest.points is not None
            self._kept_bytes -= oldest.points.nbytes
            oldest.points = None


def _settings(simulator: Simulator) -> dict[str, Any]:
    """Return what reproduces a flight besides its world, goals and configurations."""
    models = {
        "lidar": simulator.lidar.model,
        "drone": simulator.vehicle.model,
        "noise": simulator.noise,
        "rules": simulator.rules,
    }
    return {
        "seed": simulator.seeds[0],
        "device": simulator.device.alias,
        **{name: None if model is None else dataclasses.asdict(model) for name, model in models.items()},
    }


def _returns(parts: list[Cloud]) -> Cloud:
    """Join the parts of a sweep and leave out the rays without return."""
    points: Any = np.concatenate(parts)
    return np.compress(~np.isnan(points[:, 0]), points, axis=0)
