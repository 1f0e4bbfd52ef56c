"""The planning side of the node: turns the newest cloud and state into a plan that can be flown."""

from __future__ import annotations

import logging
import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aero_planner.config import PlannerConfig
from aero_planner.onboard.braking_path import choose_path
from aero_planner.onboard.cloud_drift import Drift, measure_drift
from aero_planner.onboard.dead_reckoning import MotionState, acceleration, propagate
from aero_planner.onboard.ground_plane import find_ground
from aero_planner.onboard.interfaces import ConfigChange, PlanResult, PointPacket, VehicleSample
from aero_planner.onboard.plan_schedule import PlanSchedule, ScheduledPlan
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.sweep_buffer import make_sweep_buffer
from aero_planner.onboard.tuning import Tuning
from aero_planner.plan import Goal, VehicleState
from aero_planner.planner import Planner
from aero_planner.sweeps import Sweeps

_log = logging.getLogger(__name__)

_ARRIVALS = 4096
"""States and packets that wait for the planning thread; if it hangs, the oldest are dropped."""
_DRIFT_PERIOD = 0.1
"""Time between two comparisons of the cloud with itself [s]."""
_GROUND_PERIOD = 1.0
"""Time between two searches for the ground in the cloud [s]."""
_SPARE_SWEEPS = 64
"""Number of sweeps for which the planner has room in addition to its memory."""
_STEP = 0.02
"""Time step of the prediction [s]."""


def speed_share(velocity_std: float, limit: float) -> float:
    """Return the share of the speed limit that may be flown, in tenths.

    What an error of the velocity displaces, the cloud and the plan, grows with the time for which it lasts, and a
    slower drone needs fewer metres to correct it. The share is 1 up to half the limit, and then falls in inverse
    proportion, to one half.

    Args:
        velocity_std: Standard deviation of the velocity as the autopilot states it [m/s]; NaN, unknown, limits nothing.
        limit: The largest with which the drone flies at all [m/s].
    """
    if not velocity_std > 0.5 * limit:
        return 1.0
    return max(math.floor(10.0 * 0.5 * limit / velocity_std + 1e-9) / 10.0, 0.5)


@dataclass(frozen=True, eq=False)
class ControlSnapshot:
    """Inputs of the control loop at one tick."""

    sample: VehicleSample
    motion: MotionState
    """Motion at the time of the tick."""
    goal: NDArray[np.float64] | None
    """[m], shape [3], world frame."""
    ground: float
    """Height of the ground, world frame [m]."""
    command: NDArray[np.float64] | None
    """Command that the drone obeys, shape [4]; None if it does not obey the node."""
    follows_plan: bool
    """True if the command comes from the plan."""
    disturbance: NDArray[np.float64]
    """Acceleration besides thrust and gravity [m/s^2], shape [3], world frame."""
    speed_limit: float | None = None
    """Speed limit of the present leg of a mission [m/s]; None if it has none of its own."""


class Replanner:
    """Owns the planner and the cloud.

    The control loop calls `add_arrival`, `take_ground_height` and `take_drift`; the planning thread calls `take_change`
    and `plan_once`.

    Args:
        planner: The planner.
        config: Configuration of the node.
        schedule: Receives the plans.
        clock: Host time [s].

    Attributes:
        is_finite: True if the newest plan was finite.
    """

    def __init__(
        self, planner: Planner, config: OnboardConfig, schedule: PlanSchedule, clock: Callable[[], float]
    ) -> None:
        self._planner = planner
        self._failures = 0  # calls of the planner that raised, or whose plan was not finite
        self._durations: deque[float] = deque(maxlen=10_000)  # of the last calls [s]
        self.is_finite = True
        # So that no plan has to wait for larger buffers.
        lidar = config.lidar
        memory = (lidar.sweeps + lidar.older_sweeps) * lidar.sweep_period
        plans = int(memory * config.rates.replan)  # each adds one sweep, of the points that are new
        planner.reserve_sweeps(plans + _SPARE_SWEEPS, 2 * lidar.points_max + lidar.older_points_max)
        self._sweeps = make_sweep_buffer(config)
        self._sweep_period = config.lidar.sweep_period
        self._resets = 0
        self._next_cloud = -np.inf
        self._response = config.response
        self._compensate = config.rates.compensate
        self._max_latency = 0.5 * config.limits.plan_age
        self._floor = config.limits.fence_height_min
        self._ground: tuple[int, float] | None = None  # reset counter and height of a new measurement
        self._next_ground = self._next_drift = -np.inf
        self._drift: tuple[int, Drift, float] | None = None  # reset counter, a new measurement and its interval
        self._config, self._velocity_std, self._speed_share = planner.config, config.limits.velocity_std, 1.0
        self._leg_limit = math.inf  # of the speed [m/s]
        self._schedule = schedule
        self._clock = clock
        self._arrivals: deque[VehicleSample | PointPacket] = deque(maxlen=_ARRIVALS)
        self._latency = 0.0
        self._next_error_log = -np.inf
        self._number = 0

    def statistics(self) -> dict[str, float | None]:
        """Return figures on plans and failures, and the number of points that could not be placed in the cloud."""
        plans = 1e3 * np.array(self._durations)
        return {
            "plans": len(plans),
            "plan_median_ms": float(np.median(plans)) if len(plans) else None,
            "plan_p99_ms": float(np.quantile(plans, 0.99)) if len(plans) else None,
            "planner_failures": self._failures,
            "points_dropped": self._sweeps.dropped,
        }

    def add_arrival(self, arrival: VehicleSample | PointPacket) -> None:
        """Add a state or points for the next plan."""
        self._arrivals.append(arrival)

    def warm_up(self) -> float:
        """Load the kernels by planning on artificial inputs, reset the planner, and return the time of a plan [s].

        Raises:
            RuntimeError, ValueError: The planner cannot plan on this device.
        """
        state = VehicleState(np.zeros(3), np.zeros(3), (1.0, 0.0, 0.0, 0.0))
        cloud = Sweeps([np.full((64, 3), 5.0, dtype=np.float32)])
        self._planner.plan(state, Goal((10.0, 0.0, 0.0)), cloud)
        start = time.perf_counter()
        self._planner.plan(state, Goal((10.0, 0.0, 0.0)), cloud)
        duration = time.perf_counter() - start
        self._planner.reset()
        return duration

    def plan_once(self, snapshot: ControlSnapshot | None) -> PlanResult | None:
        """Update the cloud and plan if state, goal and cloud are available; return None if there is no new plan."""
        self._process_arrivals()
        if snapshot is None:
            return None
        start = self._clock()
        cloud, cloud_age = self._sweeps.cloud(start)
        if not np.isfinite(cloud_age) or start < self._next_cloud:
            return None
        result = None if snapshot.goal is None else self._plan(snapshot, snapshot.goal, cloud, cloud_age, start)
        if start >= self._next_drift:
            self._next_drift = start + _DRIFT_PERIOD
            older, newer, interval = self._sweeps.newest_pair()
            drift = measure_drift(older, newer, snapshot.motion.position)
            self._drift = None if drift is None else (self._resets, drift, interval)
        if start >= self._next_ground:  # last, so that no plan waits for it
            self._next_ground = start + _GROUND_PERIOD
            newest = Sweeps(list(cloud)[cloud.thinned :])
            height = find_ground(newest.points, snapshot.motion.position)
            self._ground = None if height is None else (self._resets, height)
        return result

    def _plan(
        self, snapshot: ControlSnapshot, goal: NDArray[np.float64], cloud: Sweeps, cloud_age: float, start: float
    ) -> PlanResult | None:
        state = self._predict_state(snapshot, start)
        self._limit_speed(snapshot.sample.velocity_std, snapshot.speed_limit or math.inf)
        try:
            # A Mid-360 does not see the ground below it, so the planner keeps out of everything below the geofence.
            plan = self._planner.plan(
                state, Goal(goal), cloud, cloud_age=max(cloud_age, 0.0), ground_height=snapshot.ground + self._floor
            )
        except (ValueError, RuntimeError, MemoryError) as error:
            self._count_failure(f"the planner failed: {error}")
            return None
        duration = self._clock() - start
        self._durations.append(duration)
        # Rises at once and falls slowly: a plan that is ready too early waits, one that is late skips its start.
        self._latency = min(max(duration, 0.9 * self._latency + 0.1 * duration), self._max_latency)
        controls = np.asarray(plan.command, dtype=np.float64)
        self.is_finite = bool(np.isfinite(controls).all())
        if not self.is_finite:
            self._planner.reset()
            self._count_failure("the plan contains NaN or infinity")
            return None
        self._number += 1
        scheduled = ScheduledPlan(
            number=self._number,
            measured=snapshot.sample.time,
            time=float(state.time),  # type: ignore[arg-type]
            dt=self._planner.config.sampling.dt,
            controls=controls,
            status=plan.status,
            path=choose_path(plan, self._planner.config.sampling.dt),
        )
        self._schedule.append(scheduled, start)
        return PlanResult(
            number=self._number,
            time=start,
            state=state,
            measured=snapshot.sample.state,
            goal=goal,
            cloud=cloud,
            cloud_age=cloud_age,
            plan=plan,
            plan_ms=1e3 * duration,
        )

    def take_change(self, tuning: Tuning) -> ConfigChange | None:
        """Plan with the configuration that waits in `tuning`; return None if there is none."""
        return tuning.take(self._configure)

    def _configure(self, config: PlannerConfig) -> None:
        """Plan with a configuration, but for the share of its speed limit, or of the leg's, that may be flown."""
        lowest = PlannerConfig.find("vehicle.speed_limit").low or 0.0
        limit = min(config.vehicle.speed_limit, self._leg_limit)
        self._planner.configure(config.replace({"vehicle.speed_limit": max(self._speed_share * limit, lowest)}))
        self._config = config

    def _limit_speed(self, velocity_std: float, leg_limit: float) -> None:
        """Lower the planner's speed limit to that of the leg [m/s], and further while the velocity is uncertain."""
        share, before = speed_share(velocity_std, self._velocity_std), self._speed_share
        if (share, leg_limit) == (before, self._leg_limit):
            return
        self._speed_share, self._leg_limit = share, leg_limit
        self._configure(self._config)
        if share < before == 1.0:
            _log.warning("the autopilot's velocity is uncertain by %.2f m/s: the speed is limited", velocity_std)

    def take_ground_height(self, resets: int) -> float | None:
        """Return the height of the ground in the cloud, world frame [m], if it was measured since the last call.

        Args:
            resets: Present number of the estimator's resets; a height from before the last one is not returned.
        """
        measured, self._ground = self._ground, None
        return measured[1] if measured is not None and measured[0] == resets else None

    def take_drift(self, resets: int) -> tuple[Drift, float] | None:
        """Return the drift of the estimate and its interval [s], if it was measured since the last call.

        Args:
            resets: Present number of the estimator's resets; a drift from before the last one is not returned.
        """
        measured, self._drift = self._drift, None
        return measured[1:] if measured is not None and measured[0] == resets else None

    def _count_failure(self, message: str) -> None:
        self._failures += 1
        # Logged at most once per second, because every plan may fail.
        now = self._clock()
        if now >= self._next_error_log:
            self._next_error_log = now + 1.0
            _log.error("%s (%d failures so far)", message, self._failures)

    def _process_arrivals(self) -> None:
        while self._arrivals:
            arrival = self._arrivals.popleft()
            if isinstance(arrival, VehicleSample):
                if arrival.resets != self._resets:
                    self._restart(arrival)
                state = arrival.state
                self._sweeps.add_pose(arrival.time, state.position, state.quaternion)
            else:
                self._sweeps.add_points(arrival.points, arrival.times)

    def _restart(self, sample: VehicleSample) -> None:
        """Discard the cloud and the plan from before an estimator reset; plan again after one new sweep.

        Until then the last plan is flown for as long as it may be: its controls do not depend on the origin.
        """
        self._resets = sample.resets
        self._next_cloud = sample.time + self._sweep_period
        self._sweeps.clear()
        self._planner.reset()
        _log.warning("the autopilot's estimator was reset: the cloud is discarded")

    def _predict_state(self, snapshot: ControlSnapshot, now: float) -> VehicleState:
        """Return the state at the time when the plan will be ready, if the drone obeys its present commands."""
        config, motion = self._planner.config, snapshot.motion
        vehicle = config.vehicle
        target = now + self._latency if self._compensate else motion.time
        while motion.time < target:
            command = self._command_at(motion.time, snapshot)
            motion = propagate(motion, command, min(motion.time + _STEP, target), vehicle, self._response)
        command = self._command_at(motion.time, snapshot)
        control = command if motion.control is None else motion.control
        is_active = "disturbance" in config.stages.names
        is_counted = is_active and (config.disturbance.disturbance_time > 0.0 or config.disturbance.drag_time > 0.0)
        disturbance = snapshot.disturbance if is_counted else np.zeros(3)
        accel = np.zeros(3) if control is None else acceleration(motion.quaternion, float(control[0]), vehicle)
        return VehicleState(
            motion.position, motion.velocity, motion.quaternion, accel + disturbance, motion.time, disturbance
        )

    def _command_at(self, time: float, snapshot: ControlSnapshot) -> NDArray[np.float64] | None:
        """Return the command that the drone is expected to obey at `time` [s]."""
        planned = self._schedule.command(time) if snapshot.follows_plan else None
        return snapshot.command if planned is None else planned
