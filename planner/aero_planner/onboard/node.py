"""The node that flies: a control loop, a planning thread and a watchdog between a LiDAR and an autopilot.

Each thread repeats one method, `control_once`, `plan_once` or `watch_once`, so that a test can run the node in
simulated time without threads. Only the control loop reads from the LiDAR and the autopilot. It passes data to the
planning thread and to the observers as immutable records.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.missions import Mission
from aero_planner.onboard.agreement import check_together
from aero_planner.onboard.command_choice import Command, CommandChoice
from aero_planner.onboard.dead_reckoning import DeadReckoning, MotionState
from aero_planner.onboard.disturbance_estimate import DisturbanceEstimate
from aero_planner.onboard.drift_correction import DriftCorrection
from aero_planner.onboard.drift_monitor import DriftMonitor
from aero_planner.onboard.failsafe_conditions import is_inside_fence, is_lost, must_wait_after_stall
from aero_planner.onboard.failsafe_process import Failsafe, takeover_time
from aero_planner.onboard.failsafe_table import AS_PLANNED, COMMANDING, MAYBE_COMMANDING, Inputs, Reaction, State
from aero_planner.onboard.goal_tracker import GoalTracker
from aero_planner.onboard.ground_tracker import GroundTracker
from aero_planner.onboard.interfaces import Observation, Observer, PlanRecord, PointSource, VehicleLink, VehicleSample
from aero_planner.onboard.mavlink_signing import clock_is_set
from aero_planner.onboard.periodic_loop import LoopThreads, PeriodicLoop, run_step
from aero_planner.onboard.plan_schedule import PlanSchedule
from aero_planner.onboard.readiness_log import ReadinessLog
from aero_planner.onboard.replanner import ControlSnapshot, Replanner
from aero_planner.onboard.safety_machine import SafetyMachine, StateChange
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.stop_controller import StopCommand, StopController
from aero_planner.onboard.thrust_estimate import ThrustEstimate
from aero_planner.onboard.tuning import Tuning
from aero_planner.onboard.watchdog import Heartbeat, Watchdog
from aero_planner.plan import PlanStatus
from aero_planner.planner import Planner
from aero_planner.sweeps import shows_something

_log = logging.getLogger(__name__)


class Node:
    """Flies a drone to a goal while the pilot lets it.

    Args:
        planner: The planner, which the caller closes.
        link: Connection to the autopilot; closed with the node.
        lidar: Source of points; closed with the node.
        config: Configuration of the node.
        goal: Where to fly [m], shape [3], world frame, or a mission. None waits. A goal or mission over the link
            always replaces this one.
        clock: Host time [s], the same as that of link and LiDAR.
        observers: The flight log and the telemetry server, for example; closed with the node.
        failsafe: Process that brakes if this whole process does not; closed with the node. None: fly without it.
        tuning: Changes of the planner's parameters, which must be one of the observers, too. None: there are none.

    Raises:
        ValueError: The configurations of planner and node contradict each other, or the goal is invalid.

    Attributes:
        config: Configuration of the node.
        safety: The state machine, to be read only.
        schedule: The plans being flown, to be read only.
        ground: Height of the ground, to be read only.
        snapshot: What the control loop knew at its newest tick; None before the first vehicle state.
        changes: The last transitions of the safety state.
        failures: Number of ticks of the control loop that raised an exception.
        sent: Number of commands sent by the control loop.
    """

    def __init__(
        self,
        planner: Planner,
        link: VehicleLink,
        lidar: PointSource,
        config: OnboardConfig,
        *,
        goal: ArrayLike | Mission | None = None,
        clock: Callable[[], float] = time.monotonic,
        observers: Sequence[Observer] = (),
        failsafe: Failsafe | None = None,
        tuning: Tuning | None = None,
    ) -> None:
        check_together(planner.config, config)
        self.config = config
        self.changes: deque[StateChange] = deque(maxlen=1000)
        self.failures = self.sent = 0
        self._link, self._lidar = link, lidar
        self._goals = GoalTracker(config.limits, goal)
        self._clock = clock
        self._observers = tuple(observers)
        self._failsafe, self._tuning = failsafe, tuning
        self._vehicle, self._range_min = planner.config.vehicle, planner.config.partition.range_min
        self._is_signed = config.mavlink.is_signed
        self._period = 1.0 / config.rates.control
        # Silence after which the failsafe process, too, has sent its last command.
        self._replaced_time = takeover_time(config) + config.limits.blind_time + 2.0 * self._period
        self.schedule = PlanSchedule()
        self.ground = GroundTracker()
        self._replanner = Replanner(planner, config, self.schedule, clock)
        self.safety = SafetyMachine(config.limits, on_change=self._on_change)
        self._reckoning = DeadReckoning(self._vehicle, config.response)
        self._stop_controller = StopController(self._vehicle, config.brake)
        self._commands = CommandChoice(self._vehicle, config, self.schedule, self._stop_controller)
        self._thrust = ThrustEstimate(self._vehicle, config.thrust)
        self._disturbance = DisturbanceEstimate(config.response)
        self._drift = DriftMonitor(config.limits.drift_time)
        self._drift_correction = DriftCorrection()
        self._watchdog = Watchdog(
            link, self._stop_controller, self._vehicle, period=self._period, deadline=config.limits.deadline,
            blind_time=config.limits.blind_time, response=config.response,
        )  # fmt: skip
        self._readiness = ReadinessLog()
        self.snapshot: ControlSnapshot | None = None
        self._sample: VehicleSample | None = None
        self._state_finite, self._stopping, self._points_time = True, False, -math.inf
        self._fell_silent, self._closing = threading.Event(), threading.Event()
        self._loops = self._make_loops()
        self._threads = LoopThreads(self._loops, self._closing)

    def _make_loops(self) -> dict[str, PeriodicLoop]:
        period, replan_period = self._period, 1.0 / self.config.rates.replan
        options: dict[str, Any] = dict(clock=self._clock, stopped=self._closing)
        return {
            "control": PeriodicLoop(period, self._run_control, **options),
            "planning": PeriodicLoop(
                replan_period, lambda: run_step(self.plan_once, "a plan"), on_grid=False, **options
            ),
            "watchdog": PeriodicLoop(period, lambda: run_step(self.watch_once, "the watchdog"), **options),
        }

    # --- may be read by any thread ---

    @property
    def state(self) -> State:
        """The safety state."""
        return self.safety.state

    @property
    def goal(self) -> NDArray[np.float64] | None:
        """Goal [m], shape [3], world frame."""
        return self._goals.goal

    @property
    def _floor(self) -> float:
        """Height of the fence's lower end, world frame [m]."""
        return self.ground.height + self.config.limits.fence_height_min

    def statistics(self) -> dict[str, Any]:
        """Return figures on deadlines, failures and losses, as plain values."""
        counters = self._lidar.counters
        return {
            "state": self.state.name,
            "control": self._loops["control"].statistics.summary(),
            "planning": self._loops["planning"].statistics.summary(),
            **self._replanner.statistics(),
            "control_failures": self.failures,
            "watchdog_interventions": self._watchdog.interventions,
            "failsafe_interventions": self._failsafe.interventions if self._failsafe is not None else None,
            "failsafe_lost": self._failsafe.lost if self._failsafe is not None else None,
            "commands_sent": self.sent,
            "lidar_packets": counters.packets,
            "lidar_lost": counters.lost,
            "lidar_bad": counters.bad,
            "messages_ignored": sum(self._link.ignored.values()),
            "thrust_gain": self._thrust.gain,
            "ground_height": self.ground.height,
            "ground_source": self.ground.source.name,
            "changes": [f"{change.time:.3f} {change}" for change in self.changes],
        }

    # --- one step of each thread ---

    def control_once(self) -> Reaction:
        """Read the inputs that have arrived, decide, and send a command; return the decision.

        After a stall, it waits for a present vehicle state while the watchdog or the failsafe process brakes.
        """
        now = self._clock()
        loop_age = self._watchdog.silence(now)
        is_replaced = self._watchdog.braking or (self._failsafe is not None and self._failsafe.braking)
        if is_replaced:
            # What the watchdog or the failsafe process has commanded is not known here.
            self._reckoning.forget_commands(now - loop_age + self._period)
        self._link.poll()
        self._read_state()
        inputs, motion = self._gather_inputs(now, loop_age)
        if is_replaced and loop_age <= self._replaced_time and must_wait_after_stall(inputs, self.config.limits):
            # Without a heartbeat of this loop, they continue.
            self._read_points()
            return self.safety.reaction
        reaction = self.safety.step(now, inputs)
        corrected = motion
        if motion is not None:
            corrected = self._drift_correction.apply(motion, lost=is_lost(inputs, self.config.limits))
        command = self._commands.choose(now, reaction, self.state, inputs, corrected, floor=self._floor)
        if command is not None:
            self._send(command)
        elif motion is not None and self.safety.must_end_level:
            # The autopilot follows the last command until it notices the silence, so that must be a level hover.
            self._send(self._stop_controller.level(motion))
        self._report(now, motion, inputs, command, follows_plan=reaction in AS_PLANNED)
        # Last, so that a flood of packets delays no command.
        self._read_points()
        if self.state is State.WAITING:
            self._readiness.update(now, self.safety.missing(), has_goal=self.goal is not None)
        if self._stopping and self.state not in (*COMMANDING, *MAYBE_COMMANDING):
            self._fell_silent.set()
        return reaction

    def plan_once(self) -> bool:
        """Plan from the newest snapshot of the control loop; return True if there is a new plan."""
        if self._tuning is not None and (change := self._replanner.take_change(self._tuning)) is not None:
            self._notify(change)
        result = self._replanner.plan_once(self.snapshot)
        if result is None:
            return False
        self._notify(PlanRecord(
            **vars(result),
            safety=self.state, missing=self.safety.missing(), mission=self._goals.progress,
            late_ticks=self._loops["control"].statistics.missed,
            sweeps=self.config.lidar.sweeps + self.config.lidar.older_sweeps,
        ))  # fmt: skip
        return True

    def watch_once(self) -> bool:
        """Act in place of the control loop if it has stalled; return True if a command was sent."""
        if self._failsafe is not None and self._failsafe.braking:
            # This whole process was stopped. Until the control loop runs again, only the failsafe process knows the
            # last command.
            return False
        action = self._watchdog.check(self._clock())
        if action is not None and self._failsafe is not None:
            self._failsafe.report(action)  # this process acts, so that the failsafe process need not
        return action is not None

    # --- parts of a tick ---

    def _read_state(self) -> None:
        sample, previous = self._link.state, self._sample
        if sample is not None and (previous is None or sample.time > previous.time):
            state = sample.state
            self._state_finite = all(np.isfinite(v).all() for v in (state.position, state.velocity, state.quaternion))
            if self._state_finite:
                if previous is not None and sample.resets != previous.resets:
                    self._commands.forget_places(sample.time)
                    self._goals.jump()
                    self.ground.clear()
                    self._drift_correction.clear()
                if self._sample is not None:
                    predicted = self._reckoning.at(sample.time)
                    self._thrust.update(self._sample, predicted, sample)
                    self._disturbance.update(self._sample, predicted, sample)
                    self._link.thrust_gain = self._thrust.gain
                self._sample = sample
                self._reckoning.correct(sample)
                self._replanner.add_arrival(sample)
                self._notify(sample)
        elif sample is not None and previous is not None and sample.time == previous.time:
            self._sample = sample  # another message has changed its flags
        if self._sample is not None and self._sample is not previous:
            self.ground.add_sample(self._sample, previous)
            if (height := self._replanner.take_ground_height(self._sample.resets)) is not None:
                self.ground.add_cloud(self._sample.time, height)

    def _read_points(self) -> None:
        for packet in self._lidar.poll():
            if len(packet.times):
                if shows_something(packet.points, np.zeros(3), nearest=self._range_min):
                    self._points_time = max(self._points_time, float(packet.times.max()))
                self._replanner.add_arrival(packet)
                self._notify(packet)

    def _gather_inputs(self, now: float, loop_age: float) -> tuple[Inputs, MotionState | None]:
        latest, sample = self._link.state, self._sample
        if sample is not None and (measured := self._replanner.take_drift(sample.resets)) is not None:
            self._drift.add(now, *measured)
            self._drift_correction.add(now, *measured)
        self._drift.update(now)
        plan = self.schedule.at(now)
        motion = None if sample is None else self._reckoning.at(max(now, sample.time))
        event = self._goals.follow(
            self._link, now, motion, ground=self.ground.known_height, refusal=self.safety.refusal,
            flying=self.state in (State.FLYING, State.ARRIVED),
        )  # fmt: skip
        if event is not None:
            self._notify(event)
        position = np.full(3, np.nan) if motion is None else motion.position
        inputs = Inputs(
            armed=latest is not None and latest.armed,
            offboard=latest is not None and latest.offboard,
            state_age=math.inf if sample is None else now - sample.time,
            heartbeat_age=math.inf if latest is None else now - latest.heartbeat_time,
            cloud_age=now - self._points_time,
            plan_age=math.inf if plan is None else now - plan.measured,
            plan_status=PlanStatus.OK if plan is None else plan.status,
            state_finite=self._state_finite and (motion is None or motion.is_finite),
            plan_finite=self._replanner.is_finite,
            in_air=None if latest is None else latest.in_air,
            position_std=math.nan if latest is None else latest.position_std,
            velocity_std=math.nan if latest is None else latest.velocity_std,
            fix_age=math.nan if latest is None else now - latest.fix_time,
            drift_angle=self._drift.angle, drift_speed=self._drift.speed,
            inside_fence=is_inside_fence(position, self.config.limits, ground=self.ground.height),
            below_floor=bool(position[2] < self._floor),
            loop_age=loop_age,
            speed=math.nan if motion is None else motion.speed,
            goal_distance=self._goals.distance(position), goal_number=self._goals.count, stopping=self._stopping,
            transmitter_lost=latest is not None and latest.transmitter is False,
            battery_low=latest is not None and latest.battery_low,
            round_trip=math.nan if latest is None else latest.round_trip,
            supported=latest is None or latest.supported,
            guarded=self._failsafe is None or not self._failsafe.lost,
            clock_set=not self._is_signed or clock_is_set(),
        )  # fmt: skip
        return inputs, motion

    def _report(
        self, now: float, motion: MotionState | None, inputs: Inputs, command: Command | None, *, follows_plan: bool
    ) -> None:
        """Report the end of a tick to planning thread, watchdog and failsafe process."""
        control = None if command is None else command.control
        obeyed = control if inputs.armed and inputs.offboard else None
        maybe_obeyed = control if inputs.armed and self.state in MAYBE_COMMANDING else obeyed
        self._reckoning.add_command(now, obeyed)
        if self._sample is not None and motion is not None:
            self.snapshot = ControlSnapshot(
                self._sample, motion, self.goal, self.ground.height, obeyed, follows_plan,
                self._disturbance.acceleration, self._goals.speed_limit,
            )  # fmt: skip
        upcoming = self._commands.upcoming(now) if follows_plan else None
        path, gain = self._commands.path, self._thrust.gain
        heartbeat = Heartbeat(now, motion, maybe_obeyed, upcoming, path, gain, self._floor)
        self._watchdog.report(heartbeat)
        if self._failsafe is not None:
            self._failsafe.report(heartbeat)

    def _send(self, command: Command | StopCommand) -> None:
        self._link.send(*command)
        self.sent += 1

    def _on_change(self, change: StateChange) -> None:
        self.changes.append(change)
        is_fault = change.target in (State.BRAKING, State.HANDED_BACK)
        _log.log(logging.WARNING if is_fault else logging.INFO, "%s", change)
        self._notify(change)

    def _notify(self, item: Observation) -> None:
        for observer in self._observers:
            run_step(lambda observer=observer: observer.observe(item), type(observer).__name__)

    # --- start and end ---

    def warm_up(self) -> float:
        """Load the kernels before the first state arrives; return the time of a plan [s]. See `Replanner.warm_up`."""
        return self._replanner.warm_up()

    def start(self) -> None:
        """Start the threads."""
        self._threads.start()

    def stop(self) -> None:
        """Ask the node to stop the drone, if it is in control, and fall silent. Returns at once; signal-safe."""
        self._stopping = True

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until the node has fallen silent after `stop`; return True if it has."""
        return self._fell_silent.wait(timeout)

    def close(self) -> bool:
        """End the threads, command a drone that obeys to hover, and close everything.

        Returns:
            True if every thread has ended.
        """
        if self._failsafe is not None:
            self._failsafe.close()  # first, so that it does not act on this silence
        has_ended = self._threads.close()
        if self._watchdog.needed:
            self._send(Command(self._stop_controller.hover, None))  # for the same reason as in `control_once`
        self._link.close()
        self._lidar.close()
        for observer in self._observers:
            run_step(observer.close, type(observer).__name__)
        return has_ended

    def _run_control(self) -> None:
        # A tick that fails sends no heartbeat: if failures continue, the watchdog brakes.
        self.failures += not run_step(self.control_once, "a tick of the control loop")
