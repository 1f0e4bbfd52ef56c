"""A closed-loop flight as a source of the engine."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from aero_planner import Arrival, Goal, PlannerConfig, Sweeps, VehicleState
from aero_planner.mission_progress import MissionProgress
from aero_planner.missions import Mission, Position
from aero_viz.errors import UserError
from aero_viz.flight.conditions import live_conditions, with_live_conditions
from aero_viz.flight.explanation import goal_notice, waypoint_problem
from aero_viz.flight.flight_settings import FlightSettings
from aero_viz.flight.flown_mission import FlownMission
from aero_viz.flight.memory import DEFAULT_MEMORY, MOST_SWEEPS, SWEEPS, WHOLE_SWEEPS, remembered_sweeps
from aero_viz.flight.metrics import FlightResult, flight_results
from aero_viz.flight.rules import FlightRules
from aero_viz.flight.simulator import Setting, Simulator
from aero_viz.flight.state_noise import StateNoise
from aero_viz.flight.sweep_cache import Cloud, Pose, Scan, Sweep, SweepCache, join_returns
from aero_viz.flight.vehicle_model import VehicleModel
from aero_viz.planners.observation import Observation
from aero_viz.planners.plan import CandidatePlan, Plan
from aero_viz.scenes.world import World
from aero_viz.sensors.lidar import is_sweep_lost
from aero_viz.sensors.models import LIDARS, LidarModel
from aero_viz.session.source import SourceInfo

LATENCY_MAX = 0.5
"""Largest latency of the drone that can be chosen during a flight which began with less [s]."""


@dataclass(frozen=True, eq=False, slots=True)
class _Checkpoint:
    tick: int
    state: bytes
    """The arrays of the simulator, one after the other."""
    sweeps: tuple[Sweep, ...]
    scans: tuple[Scan, ...]
    """Scans of the sweep in progress."""
    mission: MissionProgress
    setting: Setting
    owner: object
    """Identifies the source that made the checkpoint."""


class FlightSource:
    """A simulated flight in a world; implements `aero_viz.session.source.Source`.

    A checkpoint takes about a kilobyte: instead of points, it holds the poses from which they can be measured again.

    Args:
        world: where to fly.
        lidar: model of the LiDAR; None is the Livox Mid-360.
        vehicle: model of the drone; None is the default vehicle. It takes commands as the plans have them.
        rules: when the flight ends. A tick of the source is the time of one plan, `ticks_per_plan` ticks of the rules.
        noise: errors of the state estimate; None gives the planner the true state.
        control_step: time step of the controls of AERO-MPPI's plans [s]; they are interpolated if a plan is flown for
            several ticks.
        seed: seed of the LiDAR pattern and all noise. Same seed, device and plans: same flight, bit for bit.
        device: Warp device.

    Raises:
        UserError: a sweep of the LiDAR takes less than a tick.

    Attributes:
        simulator: simulator of the flight.
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
            self.simulator = Simulator(
                [world],
                lidar=lidar or LIDARS["mid360"],
                vehicle=vehicle or VehicleModel.from_config(PlannerConfig()),
                rules=rules,
                seeds=[seed],
                device=device,
                noise=noise,
                latency_max=LATENCY_MAX,
            )
        except ValueError as error:
            raise UserError(f"Cannot fly {world.name!r}: {error}") from error
        self.info = SourceInfo(
            name=world.name,
            closed_loop=True,
            period=rules.period * rules.ticks_per_plan,
            start=world.start,
            world=world,
            settings=_settings(self.simulator).to_dict(),
        )
        self._control_step = control_step
        simulator = self.simulator
        self._setting = Setting(world, simulator.lidar.model, simulator.vehicle.model, noise)
        self._measured = self._setting
        """Setting of the simulator."""
        self._seed, self._mission = seed, FlownMission(simulator, world)
        self._noticed: tuple[World, Position, str | None] | None = None
        """World, goal, and what is to be said of it."""
        self._owner = object()
        self._cache = SweepCache(self._measure)
        with wp.ScopedDevice(self.simulator.device):
            self._active = wp.ones(1, dtype=int)
            self._poses = [(wp.zeros(1, dtype=wp.vec3), wp.zeros(1, dtype=wp.vec4)) for _ in range(4)]
        # The sweep in progress: its scans and their points.
        self._scans: tuple[Scan, ...] = ()
        self._parts: list[Cloud] = []
        self._read_state()
        size = self.simulator.lidar.model.rays_per_sweep
        # Before the start, the drone has hovered.
        scans = [Scan(sweep, 0, size, self._pose, self._pose, self._setting) for sweep in range(-SWEEPS, 0)]
        self._set_sweeps(tuple(Sweep((scan,), None) for scan in scans))

    @property
    def explanation(self) -> str | None:
        """How the flight ended, or that its goal cannot be reached; None if neither is to be said."""
        if self.outcome is not None:
            return self.result().explanation
        world, goal = self._setting.world, self._mission.progress.mission.goal
        if self._noticed is None or self._noticed[0] is not world or self._noticed[1] != goal:
            self._noticed = world, goal, goal_notice(world.standing(), np.array(goal))
        return self._noticed[2]

    def observe(self) -> Observation:
        """Return the estimated state, the last complete sweeps, the goal, and the true state."""
        if self._observation is None:
            sweeps, times = self._recall(DEFAULT_MEMORY)
            self._observation = Observation(
                time=self.simulator.time,
                state=self._state,
                goal=Goal(self._setting.world.inside(self._mission.goal)),
                mission=self._mission.progress,
                sweeps=sweeps,
                cloud_age=self._cloud_age,
                empty_is_clear=True,
                ground_height=self._setting.world.ground_height,
                true_state=self._true_state,
                sweep_times=times,
                world=self._setting.world,
                conditions=live_conditions(self._setting),
                recall=self._recall,
            )
        return self._observation

    def advance(self, plan: Plan) -> None:
        """Fly the first controls of `plan` for the time of one plan; does nothing if the flight is over."""
        self._obey(plan.model)
        commands = wp.array(plan.command[None], dtype=wp.vec4, device=self.simulator.device)
        rules = self.simulator.rules
        step = plan.step if isinstance(plan, CandidatePlan) else self._control_step
        for k in range(int(rules.ticks_per_plan)):
            if self.outcome is not None:
                return
            before = self._pose
            sweep, first, end = self.simulator.advance(commands, phase=k * rules.period / step)
            self._read_state()
            self._mission.follow(self._true_state, self._setting.world, outcome=self.outcome)
            if self.outcome is None:  # the LiDAR of a finished flight measures nothing
                self._scans = (*self._scans, Scan(sweep, first, end, before, self._pose, self._setting))
                self._parts.append(self._new_points(first, end))
            if end == self.simulator.lidar.model.rays_per_sweep and self._scans:
                complete = Sweep(self._scans, join_returns(self._parts))
                self._scans, self._parts = (), []
                self._cache.add(complete)
                self._set_sweeps((*self._sweeps, complete)[-MOST_SWEEPS:])

    def checkpoint(self) -> object:
        """Return the state that `restore` needs: about a kilobyte, whatever the size of the cloud."""
        tick, arrays = self.simulator.checkpoint()
        state = b"".join([array.tobytes() for array in arrays])
        return _Checkpoint(tick, state, self._sweeps, self._scans, self._mission.progress, self._setting, self._owner)

    def restore(self, checkpoint: object) -> None:
        """Continue from a checkpoint of this source or its twin. The same plans then give the same flight, bit for bit.

        This takes a few milliseconds if the sweeps are cached, see `SweepCache`; otherwise the next observation
        measures those that it needs.

        Raises:
            TypeError: the object is not a checkpoint of a flight.
        """
        if not isinstance(checkpoint, _Checkpoint):
            raise TypeError(f"{type(checkpoint).__name__} is not a checkpoint of a flight.")
        self._setting = checkpoint.setting
        self._use(self._setting)
        values, offset = [], 0
        for array in self.simulator.checkpoint()[1]:
            values.append(np.frombuffer(checkpoint.state, array.dtype, array.size, offset).reshape(array.shape))
            offset += array.nbytes
        self.simulator.restore((checkpoint.tick, values))
        self._mission.restore(checkpoint.mission)
        self._scans = checkpoint.scans
        self._parts = [self._measure(scan) for scan in self._scans]
        self._use(self._setting)
        is_own = checkpoint.owner is self._owner
        self._set_sweeps(checkpoint.sweeps if is_own else self._cache.adopt(checkpoint.sweeps))
        self._use(self._setting)
        self._read_state()

    @classmethod
    def twin(cls, info: SourceInfo) -> FlightSource:
        """Return another source of the flight `info`, for any thread, which repeats its ticks from its checkpoints."""
        assert info.world is not None
        settings = FlightSettings.from_dict(info.settings)
        return cls(
            info.world,
            lidar=settings.lidar,
            vehicle=settings.drone,
            rules=settings.rules,
            noise=settings.noise,
            seed=settings.seed,
            device=settings.device,
        )

    def seek(self, time: float) -> None:
        """Refuse: a flight has no recorded times to go to.

        Raises:
            TypeError: always.
        """
        raise TypeError("a flight has no recorded times to go to; restore one of its checkpoints.")

    def set_goal(self, position: ArrayLike) -> None:
        """Move the goal to `position` [m], [3], world frame.

        A flight that has arrived, stalled or run out of time continues. To a goal inside an obstacle, below the ground
        or outside the world's bounds, the drone flies as near as is safe, and `explanation` says so.

        Raises:
            UserError: the position is not three finite numbers within 100 000 km of the origin. The goal stays.
        """
        goal = np.array(position, dtype=np.float64)
        if goal.shape != (3,) or not np.isfinite(goal).all():
            raise UserError(f"The goal {np.asarray(position).tolist()} is not a position; give three finite numbers.")
        try:
            mission = Mission.to_goal(goal)
        except ValueError as error:
            raise UserError(f"The goal stays where it was: {error}") from None
        self._mission.begin(mission)
        self._read_state()

    def set_mission(self, mission: Mission, *, resume: bool = False) -> None:
        """Fly another mission from here. A flight that has arrived, stalled or run out of time continues.

        Args:
            mission: the mission.
            resume: True if the mission begins with the waypoints that are behind the drone and goes on from there;
                otherwise, it is flown from its first waypoint on.

        Raises:
            UserError: a waypoint before the last one lies outside the world's bounds. The mission stays.
            ValueError: with `resume`, a waypoint behind the drone differs, or none is ahead. The mission stays.
        """
        if problem := waypoint_problem(self._setting.world, mission):
            raise UserError(f"{problem}. The mission stays as it was; give positions within the bounds.")
        self._mission.begin(mission, resume=resume)
        self._read_state()

    def set_world(self, world: World) -> None:
        """Fly on among the obstacles of another world, with the same bounds. Points that were measured stay."""
        self._change(world=world)

    def set_conditions(self, values: Mapping[str, Any]) -> None:
        """Change noise, wind and faults of the sensors from now on.

        Args:
            values: values of the parameters in `conditions.LIVE`, by path.

        Raises:
            ValueError: a value is out of its bounds, or contradicts another one. Nothing changes.
        """
        self._change(**with_live_conditions(self._setting, values))

    def set_position(self, position: ArrayLike) -> None:
        """Put the drone at `position` [m], [3], world frame, with its velocity. A flight that has ended continues.

        Raises:
            UserError: an obstacle is closer than the radius of the drone, or the position is outside the world.
        """
        place = np.array(position, dtype=np.float64)
        world, radius = self._setting.world.at(self.simulator.time), self.simulator.rules.radius
        inside = place.shape == (3,) and bool(((place > world.bounds[0]) & (place < world.bounds[1])).all())
        if not inside or world.distance(place[None])[0] <= radius:
            raise UserError("The drone does not fit there; it stays where it was. Give a free position.")
        self.simulator.set_position(place[None])
        self._mission.jump()
        self._read_state()

    def _obey(self, model: str) -> None:
        """Take commands as a vehicle model of the planner has them, from now on."""
        vehicle = self._setting.vehicle
        if model != vehicle.model:
            self._change(vehicle=dataclasses.replace(vehicle, model=model, own={}))
            self.simulator.vehicle.rest()

    def _change(self, **changes: Any) -> None:
        setting = dataclasses.replace(self._setting, **changes)
        self._use(setting)
        self._setting = setting
        self._read_state()

    def _use(self, setting: Setting) -> None:
        """Make the simulator fly and measure under a setting."""
        if setting is not self._measured:
            self.simulator.use(setting)
            self._measured = setting

    def result(self) -> FlightResult:
        """Return the metrics of the flight so far."""
        simulator = self.simulator
        (result,) = flight_results(
            simulator.records(),
            [self.outcome],
            [self._setting.world],
            simulator.vehicle.position.numpy(),
            rules=simulator.rules,
            seeds=[self._seed],
            configs=[""],
            plan_ms=None,
        )
        return self._mission.complete(result)

    def close(self) -> None:
        """Do nothing: device memory is released with the source."""

    def _read_state(self) -> None:
        """Copy the true and the estimated state of the vehicle from the device."""
        vehicle, estimate = self.simulator.vehicle, self.simulator.estimate
        acceleration, time = vehicle.acceleration.numpy()[0].astype(np.float64), self.simulator.time

        def read(state: Any) -> tuple[VehicleState, Pose]:
            arrays = [array.numpy()[0] for array in (state.position, state.velocity, state.quaternion)]
            values = [array.astype(np.float64) for array in arrays]
            return VehicleState(*values, acceleration=acceleration, time=time), np.concatenate((arrays[0], arrays[2]))

        self._true_state, true_pose = read(vehicle)
        is_exact = estimate.position is vehicle.position
        self._state, estimated_pose = (self._true_state, true_pose) if is_exact else read(estimate)
        self._pose: Pose = np.stack((true_pose, estimated_pose))
        self.outcome: str | None = self.simulator.outcomes()[0]
        self._observation: Observation | None = None

    def _new_points(self, first: int, end: int) -> Cloud:
        points: Any = self.simulator.lidar.points.numpy()
        return points[0, first:end].copy()

    def _measure(self, scan: Scan) -> Cloud:
        """Measure the points of a scan again, including rays without return."""
        self._use(scan.setting)
        for (position, quaternion), pose in zip(self._poses, (*scan.before, *scan.after), strict=True):
            position.assign(pose[None, :3])
            quaternion.assign(pose[None, 3:])
        before, estimated_before, after, estimated_after = self._poses
        self.simulator.lidar.scan(
            scan.sweep,
            scan.first,
            scan.end,
            poses=after,
            poses_before=before,
            active=self._active,
            estimated_poses=estimated_after,
            estimated_poses_before=estimated_before,
        )
        return self._new_points(scan.first, scan.end)

    def _set_sweeps(self, sweeps: tuple[Sweep, ...]) -> None:
        """Go on from these sweeps, oldest first."""
        self._sweeps = sweeps
        self._clouds: dict[int, tuple[Sweeps, NDArray[np.float64]]] = {}
        lost_in_row = next((i for i, sweep in enumerate(reversed(sweeps)) if not self._is_lost(sweep)), len(sweeps))
        self._cloud_age = lost_in_row / self.simulator.lidar.model.sweep_rate
        self._observation = None

    def _recall(self, memory: float) -> tuple[Sweeps, NDArray[np.float64]]:
        """Return the sweeps of the last `memory` seconds and their times [s], the same objects until the next one."""
        lidar = self.simulator.lidar.model
        count = min(remembered_sweeps(memory, lidar), len(self._sweeps))
        if count not in self._clouds:
            sweeps = self._sweeps[-count:]
            times = np.array([lidar.sweep_end(sweep.scans[-1].sweep) for sweep in sweeps])
            arrivals = (
                Arrival(time, tuple(sweep.scans[-1].after[1, :3].tolist()))
                for time, sweep in zip(times.tolist(), sweeps, strict=True)
            )
            self._clouds[count] = Sweeps(self._cache.points(sweeps), whole=WHOLE_SWEEPS, arrivals=arrivals), times
            self._use(self._setting)
        return self._clouds[count]

    def _is_lost(self, sweep: Sweep) -> bool:
        return all(
            scan.setting.lidar.is_blind or is_sweep_lost(self._seed, scan.sweep, scan.setting.lidar.sweep_loss)
            for scan in sweep.scans
        )


def _settings(simulator: Simulator) -> FlightSettings:
    return FlightSettings(
        seed=simulator.seeds[0],
        device=simulator.device.alias,
        lidar=simulator.lidar.model,
        drone=simulator.vehicle.model,
        noise=simulator.noise,
        rules=simulator.rules,
    )
