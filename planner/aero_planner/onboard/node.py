"""The node that flies: a control loop, a planning thread and a watchdog between a LiDAR and an autopilot.

What each thread does is one method, `control_once`, `plan_once` and `watch_once`, so that a test can run the node in
simulated time without threads. The control loop alone talks to the LiDAR and the autopilot's state; the planning thread
gets what it needs as immutable records, and so do those who look on.
"""

from __future__ import annotations

import logging
import math
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.onboard.dead_reckoning import DeadReckoning, MotionState, StopController
from aero_planner.onboard.failsafe_process import FailsafeProcess, takeover_time
from aero_planner.onboard.observer import Observer, PlanRecord
from aero_planner.onboard.periodic_loop import PeriodicLoop
from aero_planner.onboard.plan_schedule import PlanSchedule
from aero_planner.onboard.point_source import PointSource
from aero_planner.onboard.replanner import ControlSnapshot, Replanner
from aero_planner.onboard.safety_machine import (
    AS_PLANNED,
    COMMANDING,
    Change,
    Inputs,
    Reaction,
    SafetyMachine,
    State,
    blind_time_left,
    inside_fence,
)
from aero_planner.onboard.settings import OnboardConfig, check_together
from aero_planner.onboard.vehicle_link import VehicleLink, VehicleSample
from aero_planner.onboard.watchdog import AHEAD, Heartbeat, Watchdog
from aero_planner.plan import PlanStatus
from aero_planner.planner import Planner

__all__ = ["Node"]

_log = logging.getLogger(__name__)

_SWITCH_INTERVAL = 0.0005
"""How long another thread may keep the interpreter from the control loop [s]."""


class Node:
    """Flies a drone to a goal as long as the pilot lets it.

    Args:
        planner: the planner; it stays the caller's.
        link: to the autopilot; closed with the node.
        lidar: the points; closed with the node.
        config: settings of the node.
        goal: where to fly [m], shape [3], world frame; None waits for one over the link, which also replaces this one.
        clock: host time [s], the one that link and LiDAR use.
        observers: the flight log, the viewers' server; closed with the node.
        guard: brakes when this whole process does not; closed with the node. None does without.

    Raises:
        ValueError: the planner's configuration and the node's contradict each other, or the goal is none.
    """

    def __init__(
        self,
        planner: Planner,
        link: VehicleLink,
        lidar: PointSource,
        config: OnboardConfig | None = None,
        *,
        goal: ArrayLike | None = None,
        clock: Callable[[], float] = time.monotonic,
        observers: Sequence[Observer] = (),
        guard: FailsafeProcess | None = None,
    ) -> None:
        config = config or OnboardConfig()
        check_together(planner.config, config)
        self.config = config
        self.changes: deque[Change] = deque(maxlen=1000)
        """The last transitions of the safety state."""
        self.failures = 0
        """Ticks of the control loop that raised."""
        self.sent = 0
        """Commands sent by the control loop."""
        self._link = link
        self._lidar = lidar
        self._goal = None if goal is None else _checked_goal(goal, config)
        self._sent_goal: NDArray[np.float64] | None = None
        self._goals = 0
        self._clock = clock
        self._observers = tuple(observers)
        self._guard = guard
        self._vehicle = planner.config.vehicle
        self._track = PlanSchedule()
        self._planning = Replanner(planner, config, self._track, clock)
        self._safety = SafetyMachine(config.limits, on_change=self._on_change)
        self._reckoning = DeadReckoning(self._vehicle)
        self._stop = StopController(self._vehicle, config.brake)
        period, replan_period, limits = 1.0 / config.rates.control, 1.0 / config.rates.replan, config.limits
        self._watchdog = Watchdog(
            link, self._stop, self._vehicle, period=period, deadline=limits.deadline, blind_time=limits.blind_time
        )
        self._situation: ControlSnapshot | None = None
        self._sample: VehicleSample | None = None
        self._state_finite = True
        self._points_time = -math.inf
        self._hold: NDArray[np.float64] | None = None
        self._stopping = False
        self._ended = threading.Event()
        self._stopped = threading.Event()
        loop: dict[str, Any] = dict(clock=clock, stopped=self._stopped)
        self._pacers = {
            "control": PeriodicLoop(period, self._control, **loop),
            "planning": PeriodicLoop(replan_period, lambda: _tried(self.plan_once, "a plan"), on_grid=False, **loop),
            "watchdog": PeriodicLoop(period, lambda: _tried(self.watch_once, "the watchdog"), **loop),
        }
        self._threads: list[threading.Thread] = []

    # --- what anyone may read ---------------------------------------------------------------------------------------

    @property
    def state(self) -> State:
        """The safety state."""
        return self._safety.state

    @property
    def safety(self) -> SafetyMachine:
        """The state machine; only read it."""
        return self._safety

    @property
    def goal(self) -> NDArray[np.float64] | None:
        """Where to fly [m], shape [3], world frame."""
        return self._goal

    def statistics(self) -> dict[str, Any]:
        """Return how well deadlines are kept and what was lost, as plain numbers."""
        plans = 1e3 * np.array(self._planning.durations)
        counters = self._lidar.counters
        return {
            "state": self.state.name,
            "control": self._pacers["control"].statistics.summary(),
            "planning": self._pacers["planning"].statistics.summary(),
            "plans": len(plans),
            "plan_median_ms": float(np.median(plans)) if len(plans) else None,
            "plan_p99_ms": float(np.quantile(plans, 0.99)) if len(plans) else None,
            "planner_failures": self._planning.failures,
            "control_failures": self.failures,
            "watchdog_interventions": self._watchdog.interventions,
            "failsafe_interventions": self._guard.interventions if self._guard is not None else None,
            "failsafe_lost": self._guard.lost if self._guard is not None else None,
            "commands_sent": self.sent,
            "lidar_packets": counters.packets,
            "lidar_lost": counters.lost,
            "lidar_bad": counters.bad,
            "points_dropped": self._planning.dropped_points,
            "changes": [f"{change.time:.3f} {change}" for change in self.changes],
        }

    # --- one step of each thread ------------------------------------------------------------------------------------

    def control_once(self) -> Reaction:
        """Take in what has arrived, decide, command; return the decision."""
        now = self._clock()
        loop_age = self._watchdog.silence(now)
        self._link.poll()
        self._take_state()
        inputs, motion = self._inputs(now, loop_age)
        before = self._safety.state
        reaction = self._safety.step(now, inputs)
        obeyed = inputs.armed and inputs.offboard
        command = self._command(now, reaction, inputs, motion)
        if command is not None:
            self._send(command)
        elif before in COMMANDING and self._safety.state is State.HANDED_BACK and obeyed:
            # The autopilot follows the last command until it notices the silence: let it be to hover without turning.
            self._send(self._stop.hover)
        given = command if obeyed else None
        self._reckoning.command(now, given)
        if self._sample is not None and motion is not None:
            self._situation = ControlSnapshot(self._sample, motion, self._goal, given, reaction in AS_PLANNED)
        beat = Heartbeat(now, motion, given, self._ahead(now) if reaction in AS_PLANNED else None)
        self._watchdog.beat(beat)
        if self._guard is not None:
            self._guard.beat(beat)
        # Last, so that a flood of packets delays no command.
        self._take_points()
        if self._stopping and self._safety.state not in COMMANDING:
            self._ended.set()
        return reaction

    def plan_once(self) -> bool:
        """Plan from what the control loop knew last; return whether there is a new plan."""
        made = self._planning.plan_once(self._situation)
        if made is None:
            return False
        if self._observers:
            record = PlanRecord(
                number=made.number,
                time=made.time,
                state=made.state,
                measured=made.situation.sample.state,
                goal=made.goal,
                points=made.points,
                cloud_age=made.cloud_age,
                plan=made.plan,
                plan_ms=made.plan_ms,
                safety=self._safety.state,
                missing=self._safety.missing(),
                late_ticks=self._pacers["control"].statistics.missed,
                sweeps=self.config.lidar.sweeps,
            )
            self._tell(lambda observer: observer.plan(record))
        return True

    def watch_once(self) -> bool:
        """Speak for the control loop if it stands still; return whether a command was sent."""
        guard = self._guard
        if guard is not None and guard.braking:
            return False  # this process was stopped: until the control loop is back, the guard knows better
        done = self._watchdog.check(self._clock())
        if done is not None and guard is not None:
            guard.beat(done)  # this process speaks: the guard need not
        return done is not None

    # --- parts of a tick --------------------------------------------------------------------------------------------

    def _take_state(self) -> None:
        sample, before = self._link.state, self._sample
        if sample is not None and (before is None or sample.time > before.time):
            state = sample.state
            self._state_finite = all(np.isfinite(v).all() for v in (state.position, state.velocity, state.quaternion))
            if self._state_finite:
                if before is not None and sample.resets != before.resets:
                    self._hold = None  # the place to hold is elsewhere now, by as much as the estimate has jumped
                self._sample = sample
                self._reckoning.correct(sample)
                self._planning.take(sample)
                self._tell(lambda observer: observer.sample(sample))
        elif sample is not None and before is not None and sample.time == before.time:
            self._sample = sample  # a heartbeat has changed its flags
        self._take_goal(self._link.goal)

    def _take_goal(self, goal: NDArray[np.float64] | None) -> None:
        """Take over a goal that has come over the link; one outside the fence is refused, and the goal stays."""
        if goal is None or (self._sent_goal is not None and np.array_equal(goal, self._sent_goal, equal_nan=True)):
            return
        self._sent_goal = np.array(goal, dtype=np.float64)
        if inside_fence(goal, self.config.limits):
            self._goal, self._goals = self._sent_goal, self._goals + 1
            _log.info("the goal is %s", np.round(self._goal, 2).tolist())
        else:
            _log.error("the goal %s is refused: it lies outside the geofence", np.round(goal, 2).tolist())

    def _take_points(self) -> None:
        for packet in self._lidar.poll():
            if len(packet.times):
                self._points_time = max(self._points_time, float(packet.times.max()))
                self._planning.take(packet)
                self._tell(lambda observer, packet=packet: observer.points(packet))

    def _inputs(self, now: float, loop_age: float) -> tuple[Inputs, MotionState | None]:
        latest, sample = self._link.state, self._sample
        plan = self._track.at(now)
        motion = None if sample is None else self._reckoning.at(max(now, sample.time))
        position = np.full(3, np.nan) if motion is None else motion.position
        inputs = Inputs(
            armed=latest is not None and latest.armed,
            offboard=latest is not None and latest.offboard,
            state_age=math.inf if sample is None else now - sample.time,
            heartbeat_age=math.inf if latest is None else now - latest.heartbeat_time,
            cloud_age=now - self._points_time,
            plan_age=math.inf if plan is None else now - plan.measured,
            plan_status=PlanStatus.OK if plan is None else plan.status,
            state_finite=self._state_finite and (motion is None or motion.finite),
            plan_finite=self._planning.finite,
            inside_fence=inside_fence(position, self.config.limits),
            loop_age=loop_age,
            speed=math.nan if motion is None else motion.speed,
            goal_distance=math.inf if self._goal is None else float(np.linalg.norm(self._goal - position)),
            goal_number=self._goals,
            stopping=self._stopping,
        )
        return inputs, motion

    def _command(
        self, now: float, reaction: Reaction, inputs: Inputs, motion: MotionState | None
    ) -> NDArray[np.float64] | None:
        """Return thrust [N] and body rates [rad/s], shape [4]; None for silence."""
        if reaction is not Reaction.HOLD:
            self._hold = None
        if reaction is Reaction.SILENT or motion is None:
            return None
        if reaction in AS_PLANNED and (planned := self._track.command(now)) is not None:
            return planned
        if reaction is Reaction.HOLD and self._hold is None and motion.speed <= self.config.limits.speed_stopped:
            self._hold = motion.position
        return self._stop.command(motion, hold=self._hold, remaining=blind_time_left(inputs, self.config.limits))

    def _ahead(self, now: float) -> NDArray[np.float64]:
        """Return what is to be flown in the periods to come if no tick follows, shape [n, 4]."""
        period, limits = 1.0 / self.config.rates.control, self.config.limits
        count = min(AHEAD, math.ceil(takeover_time(self.config) / period))
        return self._bounded(self._track.ahead(now, period=period, count=count, age_max=limits.plan_age))

    def _bounded(self, command: NDArray[np.float64]) -> NDArray[np.float64]:
        vehicle = self._vehicle
        xy, z = vehicle.rate_xy_max, vehicle.rate_z_max
        return np.clip(command, (vehicle.thrust_min, -xy, -xy, -z), (vehicle.thrust_max, xy, xy, z))

    def _send(self, command: NDArray[np.float64]) -> None:
        self._link.send(self._bounded(command))
        self.sent += 1

    def _on_change(self, change: Change) -> None:
        self.changes.append(change)
        bad = change.target in (State.BRAKING, State.HANDED_BACK)
        _log.log(logging.WARNING if bad else logging.INFO, "%s", change)
        self._tell(lambda observer: observer.change(change))

    def _tell(self, call: Callable[[Observer], None]) -> None:
        for observer in self._observers:
            try:
                call(observer)
            except Exception:
                _log.exception("%s failed", type(observer).__name__)

    # --- life -------------------------------------------------------------------------------------------------------

    def warm_up(self) -> float:
        """Load the kernels before the first state comes; returns the time of a plan [s]. See `Replanner.warm_up`."""
        return self._planning.warm_up()

    def start(self) -> None:
        """Start the threads."""
        if self._threads:
            raise RuntimeError("the node was already started.")
        self._switch_interval = sys.getswitchinterval()
        sys.setswitchinterval(_SWITCH_INTERVAL)
        for name, pacer in self._pacers.items():
            thread = threading.Thread(target=pacer.run, name=f"aero-planner-{name}", daemon=True)
            self._threads.append(thread)
            thread.start()

    def stop(self) -> None:
        """Let the drone come to rest, if it is ours, and then be silent; returns at once, safe in a signal handler."""
        self._stopping = True

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until the node has fallen silent after `stop`; return whether it has."""
        return self._ended.wait(timeout)

    def close(self) -> bool:
        """Tell a drone that obeys to hover, end, release what is held; return whether every thread has ended."""
        if self._guard is not None:
            self._guard.close()  # first: to it, this silence is none to fill
        self._stopped.set()
        for thread in self._threads:
            thread.join(timeout=2.0)
        if self._threads:
            sys.setswitchinterval(self._switch_interval)
        if self._watchdog.needed:
            self._send(self._stop.hover)  # for the same reason as in `control_once`
        self._link.close()
        self._lidar.close()
        self._tell(lambda observer: observer.close())
        return not any(thread.is_alive() for thread in self._threads)

    def _control(self) -> None:
        # One that fails is not counted as a tick: if it goes on, the watchdog brakes.
        self.failures += not _tried(self.control_once, "a tick of the control loop")


def _tried(step: Callable[[], Any], name: str) -> bool:
    """Do a thread's step, whatever it raises; return whether it raised nothing."""
    try:
        step()
    except Exception:
        _log.exception("%s failed", name)
        return False
    return True


def _checked_goal(goal: ArrayLike, config: OnboardConfig) -> NDArray[np.float64]:
    array = np.array(goal, dtype=np.float64)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise ValueError(f"the goal is {array.tolist()}; it must be three finite numbers [m].")
    if not inside_fence(array, config.limits):
        raise ValueError(f"the goal {array.tolist()} lies outside the geofence; correct it or limits.fence_*.")
    return array
