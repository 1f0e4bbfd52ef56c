"""The planner's side of the node: from the newest cloud and state to a plan that can be flown."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aero_planner.onboard.dead_reckoning import MotionState, acceleration, propagate
from aero_planner.onboard.plan_schedule import PlanSchedule, ScheduledPlan
from aero_planner.onboard.point_source import PointPacket
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.sweep_buffer import SweepBuffer
from aero_planner.onboard.vehicle_link import VehicleSample
from aero_planner.plan import Goal, Plan, PlanStatus, VehicleState
from aero_planner.planner import Planner
from aero_planner.quaternions import quaternion_from_angles

__all__ = ["ControlSnapshot", "PlanResult", "Replanner"]

_log = logging.getLogger(__name__)

_ARRIVALS = 4096
"""States and packets that may wait for the planning thread; when it hangs, the oldest go."""
_STEP = 0.02
"""Of the prediction [s]."""


@dataclass(frozen=True, eq=False)
class ControlSnapshot:
    """What the control loop knows; replaced whole at each tick."""

    sample: VehicleSample
    motion: MotionState
    """At the time of the tick."""
    goal: NDArray[np.float64] | None
    command: NDArray[np.float64] | None
    """What the drone obeys, shape [4]; None where it does not obey us."""
    flying: bool
    """Whether that comes from the plan."""


@dataclass(frozen=True, eq=False)
class PlanResult:
    """A plan and what it was made from."""

    number: int
    time: float
    situation: ControlSnapshot
    goal: NDArray[np.float64]
    state: VehicleState
    points: NDArray[np.float32]
    cloud_age: float
    plan: Plan
    plan_ms: float


class Replanner:
    """Owns the planner and the cloud; called from one thread, save `take`.

    Args:
        planner: the planner.
        config: of the node.
        track: where plans go.
        clock: host time [s].
    """

    def __init__(
        self, planner: Planner, config: OnboardConfig, track: PlanSchedule, clock: Callable[[], float]
    ) -> None:
        lidar = config.lidar
        self.planner = planner
        self.failures = 0
        """Calls of the planner that raised, or whose plan was not finite."""
        self.durations: deque[float] = deque(maxlen=10_000)
        """Of the last calls [s]."""
        self.finite = True
        """Whether the newest plan was."""
        planner.reserve(lidar.points_max)  # so that no plan has to wait for larger buffers
        self._sweeps = SweepBuffer(
            lidar.sweeps,
            lidar.sweep_period,
            lidar.points_max,
            mount_position=(lidar.mount_x, lidar.mount_y, lidar.mount_z),
            mount_quaternion=quaternion_from_angles(lidar.mount_roll, lidar.mount_pitch, lidar.mount_yaw),
            clock=clock,
        )
        self._sweep_period = lidar.sweep_period
        self._resets = 0
        self._next_cloud = -np.inf
        self._compensate = config.rates.compensate
        self._longest = 0.5 * config.limits.plan_age
        self._fence_height = config.limits.fence_height_min
        self._track = track
        self._clock = clock
        self._arrivals: deque[VehicleSample | PointPacket] = deque(maxlen=_ARRIVALS)
        self._latency = 0.0
        self._next_complaint = -np.inf
        self._number = 0

    @property
    def dropped_points(self) -> int:
        """Points without a place in the cloud."""
        return self._sweeps.dropped

    def take(self, arrival: VehicleSample | PointPacket) -> None:
        """Leave a state or points for the next plan; called by the control loop."""
        self._arrivals.append(arrival)

    def warm_up(self) -> float:
        """Plan once from nothing, so that the kernels are loaded, and forget it; returns the time of a second call [s].

        Raises:
            RuntimeError, ValueError: the planner cannot plan here.
        """
        state = VehicleState(np.zeros(3), np.zeros(3), (1.0, 0.0, 0.0, 0.0))
        cloud = np.full((64, 3), 5.0, dtype=np.float32)
        self.planner.plan(state, Goal((10.0, 0.0, 0.0)), cloud)
        began = time.perf_counter()
        self.planner.plan(state, Goal((10.0, 0.0, 0.0)), cloud)
        took = time.perf_counter() - began
        self.planner.reset()
        return took

    def plan_once(self, situation: ControlSnapshot | None) -> PlanResult | None:
        """Update the cloud and, when state, goal and cloud are there, plan; None when there is no new plan."""
        self._place_arrivals()
        if situation is None or situation.goal is None:
            return None
        began = self._clock()
        points, age = self._sweeps.cloud(began)
        if not np.isfinite(age) or began < self._next_cloud:
            return None
        state = self._state(situation, began)
        try:
            # A Mid-360 does not see the ground below it: the planner avoids everything below the geofence instead.
            plan = self.planner.plan(
                state, Goal(situation.goal), points, cloud_age=max(age, 0.0), ground_height=self._fence_height
            )
        except (ValueError, RuntimeError, MemoryError) as error:
            self._fail(f"the planner failed: {error}")
            return None
        took = self._clock() - began
        self.durations.append(took)
        # Rises at once and falls slowly: a plan that is ready too early waits, one that is late skips its start.
        self._latency = min(max(took, 0.9 * self._latency + 0.1 * took), self._longest)
        controls = np.asarray(plan.command, dtype=np.float64)
        if not np.isfinite(controls).all():
            self.planner.reset()
            self.finite = False
            self._fail("the plan is not finite")
            return None
        self.finite = True
        self._number += 1
        dt = self.planner.config.sampling.dt
        status = PlanStatus(int(plan.status))  # type: ignore[arg-type]
        flown = ScheduledPlan(self._number, situation.sample.time, float(state.time), dt, controls, status)  # type: ignore[arg-type]
        self._track.append(flown, began)
        return PlanResult(self._number, began, situation, situation.goal, state, points, age, plan, 1e3 * took)

    def _fail(self, text: str) -> None:
        self.failures += 1
        # Once per second: it may happen at every plan.
        now = self._clock()
        if now >= self._next_complaint:
            self._next_complaint = now + 1.0
            _log.error("%s (%d failures so far)", text, self.failures)

    def _place_arrivals(self) -> None:
        while self._arrivals:
            arrival = self._arrivals.popleft()
            if isinstance(arrival, VehicleSample):
                if arrival.resets != self._resets:
                    self._begin_anew(arrival)
                state = arrival.state
                self._sweeps.add_pose(arrival.time, state.position, state.quaternion)
            else:
                self._sweeps.add_points(arrival.points, arrival.times)

    def _begin_anew(self, sample: VehicleSample) -> None:
        """Forget the cloud and the plan of before the estimate's jump; plan again when there is a sweep.

        Until then the last plan is flown, as long as it may be: controls do not depend on where the origin is.
        """
        self._resets = sample.resets
        self._next_cloud = sample.time + self._sweep_period
        self._sweeps.clear()
        self.planner.reset()
        _log.warning("the autopilot's estimate has jumped: the cloud begins anew")

    def _state(self, situation: ControlSnapshot, now: float) -> VehicleState:
        """Return the state to plan from: where the drone will be when the plan is ready, flying what it flies now."""
        vehicle = self.planner.config.vehicle
        motion = situation.motion
        target = now + self._latency if self._compensate else motion.time
        command = situation.command
        while motion.time < target:
            command = self._next_command(situation, motion.time)
            motion = propagate(motion, command, min(motion.time + _STEP, target), vehicle)
        command = self._next_command(situation, motion.time)
        change = np.zeros(3) if command is None else acceleration(motion.quaternion, float(command[0]), vehicle)
        return VehicleState(motion.position, motion.velocity, motion.quaternion, change, motion.time)

    def _next_command(self, situation: ControlSnapshot, time: float) -> NDArray[np.float64] | None:
        """Return what the drone will obey at `time` [s], as far as is known."""
        planned = self._track.command(time) if situation.flying else None
        return situation.command if planned is None else planned
