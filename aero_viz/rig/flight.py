"""The loop of a flight on the rig: simulation, pilot, ground station, faults, and the rules that end the flight."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from aero_planner.quaternions import rotate
from aero_viz.flight.rules import FlightRules
from aero_viz.rig.autopilot import PERIOD, SimulatedAutopilot
from aero_viz.rig.faults import NETWORK_FAULTS, OWN_FAULTS, Fault
from aero_viz.rig.lockstep_node import LockstepNode
from aero_viz.rig.offboard import Mode
from aero_viz.rig.process import NodeProcess, raised_priority
from aero_viz.rig.px4_autopilot import Px4Autopilot
from aero_viz.rig.result import Event, Handover, RigResult, Trajectory, intervals_of, sign_changes_of
from aero_viz.rig.sensor import SimulatedMid360
from aero_viz.scenes import World

_COLLISION_STEPS = 5  # steps between two checks for a collision
_REST_SPEED = 0.2  # [m/s]; a slower vehicle counts as at rest
_REST_TIME = 2.0  # [s] at rest, or near the goal, that end a flight
_GOAL_PERIOD = 1.0  # [s] between two messages with the goal
_START_TIMEOUT = 60.0  # [s] for the node to start and stream; the first start compiles kernels
_RESTART_TIME = 10.0  # [s] in which a restarted node is still watched


class RigFlight:
    """One flight. Times of events count from the engagement, when the node gets control of the vehicle.

    Args:
        world: where to fly.
        autopilot, sensor: the simulated drone.
        node: the process under test. A `LockstepNode` makes the flight run in simulated time.
        send_goal: sends a goal [m], shape [3], world frame, to the node.
        faults: faults to inject.
        duration: longest flight [s].
        shuttle: fly back and forth between start and goal until the duration is over.
        progress: called with a sentence when something happens.
    """

    def __init__(
        self,
        world: World,
        autopilot: SimulatedAutopilot | Px4Autopilot,
        sensor: SimulatedMid360,
        node: NodeProcess | LockstepNode,
        *,
        send_goal: Callable[[NDArray[np.float64]], None],
        faults: Sequence[Fault],
        duration: float,
        shuttle: bool,
        progress: Callable[[str], None] | None,
    ) -> None:
        self._world, self._autopilot, self._sensor, self._node = world, autopilot, sensor, node
        self._send_goal = send_goal
        self._faults = list(faults)
        self._pending_faults = sorted(faults, key=lambda fault: fault.at)
        self._active_faults: list[Fault] = []
        self._duration, self._shuttle, self._progress = duration, shuttle, progress
        self._rules = FlightRules()
        self._goal = world.goal
        self._arrivals = 0
        self._events: list[Event] = []
        self._engaged_at: float | None = None  # [s] since the start of the simulation
        self._rows: list[tuple[float, ...]] = []  # time, position, velocity, 1.0 in OFFBOARD, tilt [rad]
        self._now, self._tick, self._goal_sent_at = 0.0, 0, -math.inf  # [s], and number of the next step
        self._overruns = 0
        self._at_rest_since = self._near_goal_since = math.inf
        self._mode = autopilot.mode
        self._handover: Handover | None = None
        self._reason = ""
        self._noted_until = -math.inf  # time of the node's newest transition among the events

    def run(self) -> None:
        """Start the node and fly until the flight ends."""
        self._add_event("node started")
        self._node.start()
        with raised_priority():
            self._run_loop()

    def result(self, seed: int, period: float) -> RigResult:
        """Return the result.

        Args:
            seed: seed of the flight, for the result.
            period: nominal time between two setpoints [s].
        """
        rows = np.array(self._rows) if self._rows else np.zeros((0, 9))
        trajectory = Trajectory(rows[:, 0], rows[:, 1:4], rows[:, 4:7], rows[:, 7] > 0.0)
        length = float(np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1).sum())
        flight_time = float(rows[-1, 0]) if len(rows) else 0.0
        clearance = self._min_clearance(self._rows) if self._rows else math.inf
        setpoints = self._autopilot.setpoints
        return RigResult(
            arrived=self._reason == "arrived",
            reason=self._reason,
            arrivals=self._arrivals,
            flight_time_s=flight_time,
            mean_speed=length / flight_time if flight_time else 0.0,
            max_speed=float(trajectory.speeds().max(initial=0.0)),
            min_clearance=clearance if math.isfinite(clearance) else None,
            scene=self._world.name,
            seed=seed,
            faults=[str(fault) for fault in self._faults],
            events=self._events,
            setpoints=sum(setpoint.mode is Mode.OFFBOARD for setpoint in setpoints),
            refused=self._autopilot.refused,
            violations=self._autopilot.violations,
            intervals=None if self._faults else intervals_of(setpoints, period),
            sign_changes=None if self._faults else sign_changes_of(setpoints),
            overruns=self._overruns,
            handover=self._handover,
            log=self._node.log(),
            trajectory=trajectory,
            commands=setpoints,
        )

    @property
    def now(self) -> float:
        """Time since the start of the simulation [s]."""
        return self._now

    def advance(self, seconds: float) -> None:
        """Simulate for some time, or until the flight ends, without waiting for the clock."""
        for _ in range(round(seconds / PERIOD)):
            if not self._reason:
                self._step()

    def _run_loop(self) -> None:
        start = time.monotonic()
        self._autopilot.start()
        while not self._reason:
            if not isinstance(self._node, LockstepNode):
                wait = start + (self._tick + 1) * PERIOD - time.monotonic()
                if wait > 0.0:
                    time.sleep(wait)
                elif wait < -PERIOD and self._engaged_at is not None:
                    self._overruns += 1
            self._step()

    def _step(self) -> None:
        tick = self._tick
        self._tick, self._now = tick + 1, (tick + 1) * PERIOD
        self._autopilot.step(tick, self._now)
        self._sensor.step(tick, self._autopilot.vehicle, self._now)
        if self._now - self._goal_sent_at >= _GOAL_PERIOD:
            self._send_goal(self._goal)
            self._goal_sent_at = self._now
        if self._engaged_at is None:
            self._act_as_pilot(self._now)
        else:
            self._observe(tick, self._now - self._engaged_at)
        if isinstance(self._node, LockstepNode):
            self._node.step(self._now)
            self._note_changes(self._node)

    def _note_changes(self, process: LockstepNode) -> None:
        """Note what the node has decided since the last step."""
        if self._engaged_at is None or process.node is None:
            return
        for change in process.node.changes:
            if change.time > self._noted_until:
                self._noted_until = change.time
                self._add_event(f"node: {change}", change.time - self._engaged_at)

    def _act_as_pilot(self, now: float) -> None:
        """Arm and take off once the node runs, and switch to OFFBOARD when it has been streaming for a while."""
        if not self._node.running:
            self._reason = "not_ready"
            self._add_event("node ended")
        elif now > _START_TIMEOUT:
            self._reason = "not_ready"
        elif not self._autopilot.armed:
            if self._autopilot.ready_to_arm:
                self._autopilot.arm()
                self._add_event("pilot arms and takes off")
        elif self._autopilot.engage():
            self._engaged_at = self._noted_until = now
            self._mode = Mode.OFFBOARD
            self._add_event("pilot switches to OFFBOARD, autopilot accepts")

    def _observe(self, tick: int, now: float) -> None:
        """Record one step at the time `now` after the engagement, switch faults, and end the flight if it is over."""
        autopilot = self._autopilot
        is_offboard = autopilot.mode is Mode.OFFBOARD
        tilt = math.acos(min(1.0, float(rotate(autopilot.quaternion, [0.0, 0.0, 1.0])[2])))
        self._rows.append((now, *autopilot.position, *autopilot.velocity, float(is_offboard), tilt))
        if autopilot.mode is not self._mode:
            self._mode = autopilot.mode
            change = "returns to OFFBOARD" if is_offboard else f"leaves OFFBOARD for {autopilot.mode_name}"
            self._add_event(f"autopilot {change}", now)
            if not is_offboard:
                self._handover = self._handover or Handover(now, float(np.linalg.norm(autopilot.velocity)), tilt)
        self._switch_faults(now)
        arrived = self._has_arrived(now)
        self._arrivals += arrived
        if arrived and self._shuttle:
            self._goal = self._world.start if self._goal is self._world.goal else self._world.goal
            self._send_goal(self._goal)
        reason = self._end_reason(tick, now, arrived)
        if reason is not None:
            self._reason = reason
            self._add_event(reason, now)

    def _has_arrived(self, now: float) -> bool:
        """Return True when the node has kept the vehicle near the goal for long enough and all faults have begun."""
        distance = np.linalg.norm(self._autopilot.position - self._goal)
        is_near = distance <= self._rules.arrival_radius
        self._near_goal_since = min(self._near_goal_since, now) if is_near else math.inf
        is_offboard = self._autopilot.mode is Mode.OFFBOARD
        return is_offboard and now - self._near_goal_since >= _REST_TIME and not self._pending_faults

    def _end_reason(self, tick: int, now: float, arrived: bool) -> str | None:
        """Return why the flight ends now, see `RigResult.reason`; None if it continues."""
        position, is_offboard = self._autopilot.position, self._autopilot.mode is Mode.OFFBOARD
        is_at_rest = np.linalg.norm(self._autopilot.velocity) <= _REST_SPEED
        self._at_rest_since = min(self._at_rest_since, now) if is_at_rest else math.inf
        has_rested = now - self._at_rest_since >= _REST_TIME
        low, high = self._world.bounds
        if tick % _COLLISION_STEPS == 0 and self._min_clearance(self._rows[-_COLLISION_STEPS:]) < self._rules.radius:
            return "collision"
        if not np.all((position >= low) & (position <= high)):
            return "out_of_bounds"
        if arrived and not self._shuttle:
            return "arrived"
        if has_rested and not is_offboard and not self._pending_faults and not self._is_restarting(now):
            return "held"
        if now < self._duration:
            return None
        if self._shuttle and self._arrivals:
            return "arrived"
        return "stopped" if has_rested and is_offboard else "timeout"

    def _is_restarting(self, now: float) -> bool:
        """Return True while a node that was killed and restarted could still send setpoints."""
        return any(fault.kind == "restart-node" and now < fault.at + _RESTART_TIME for fault in self._faults)

    def _switch_faults(self, now: float) -> None:
        """Begin and end faults that are due at the time `now` after the engagement."""
        while self._pending_faults and self._pending_faults[0].at <= now:
            fault = self._pending_faults.pop(0)
            self._add_event(f"fault: {fault}", now)
            if fault.kind in ("kill-node", "restart-node"):
                self._node.kill()
                if fault.kind == "restart-node":
                    self._node.start()
            else:
                self._active_faults.append(fault)
                self._apply(fault, active=True)
        for fault in [fault for fault in self._active_faults if fault.end <= now]:
            self._active_faults.remove(fault)
            self._apply(fault, active=False)
            self._add_event(f"over: {fault.kind}", now)

    def _apply(self, fault: Fault, *, active: bool) -> None:
        if fault.kind in NETWORK_FAULTS:
            for channel in (self._autopilot.to_companion, self._autopilot.from_companion, self._sensor.channel):
                if active:
                    channel.faults[fault.kind] = fault.amount or 0.0
                else:
                    channel.faults.pop(fault.kind, None)
        elif fault.kind == "freeze-state":
            self._autopilot.frozen = active
        elif fault.kind == "lose-position":
            self._autopilot.lose_position(active)
        elif fault.kind in OWN_FAULTS:
            assert isinstance(self._autopilot, SimulatedAutopilot)  # checked by `fly_rig`
            self._autopilot.velocity_error = (fault.amount or 0.0) if active else 0.0
        elif fault.kind == "low-battery":
            if active:
                self._autopilot.drain_battery()
        elif fault.kind == "lose-transmitter":
            self._autopilot.lose_transmitter(active)
        elif fault.kind == "take-over":
            # If no setpoints arrive, the autopilot refuses the way back.
            _ = self._autopilot.hold() if active else self._autopilot.engage()
        elif fault.kind == "kill-sensor":
            self._sensor.alive = not active
        elif active:
            self._node.pause()
        else:
            self._node.resume()

    def _add_event(self, text: str, now: float = 0.0) -> None:
        self._events.append(Event(None if self._engaged_at is None else now, text))
        if self._progress is not None:
            self._progress(f"{now:6.2f} s  {text}")

    def _min_clearance(self, rows: Sequence[tuple[float, ...]]) -> float:
        times, positions = np.split(np.array(rows)[:, :4], [1], axis=1)
        return float(self._world.distance(positions, times[:, 0] + (self._engaged_at or 0.0)).min())
