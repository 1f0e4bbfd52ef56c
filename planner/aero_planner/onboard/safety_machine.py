"""The safety state machine: runs `failsafe_table` over time, without clocks, threads or I/O."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

from aero_planner.onboard.failsafe_conditions import cause_applies, find_faults, next_state
from aero_planner.onboard.failsafe_table import (
    COMMANDING,
    MAYBE_COMMANDING,
    NOT_READY,
    Cause,
    Inputs,
    Reaction,
    State,
    reaction_to,
)
from aero_planner.onboard.settings import LimitSettings

_FORGIVENESS = 0.2
"""Part of the time without faults that is subtracted from the time with faults: a drone that alternates between flying
and braking, and brakes for more than a sixth of the time, is handed back in the end."""


@dataclass(frozen=True)
class StateChange:
    """A transition that has taken place."""

    time: float
    """Time of the tick, as passed to `SafetyMachine.step` [s]."""
    source: State
    target: State
    cause: Cause

    @property
    def refusal(self) -> str:
        """Why nothing that was asked for is taken after it; empty if it may be."""
        if self.target not in (State.BRAKING, State.WITHDRAWING):
            return ""
        return f"the drone is braking: {self.cause.value}; nothing changes until it has stopped."

    def __str__(self) -> str:
        return f"{self.source.name} -> {self.target.name}: {self.cause.value}"


class SafetyMachine:
    """The safety state, and the memory that is needed to decide on the next one.

    Args:
        limits: See `LimitSettings`.
        on_change: Called with every transition.

    Attributes:
        state: The present state.
        inputs: Inputs of the newest step, completed by the machine; None before the first.
        must_end_level: True if silence begins with the newest step and the drone obeys, or may obey, the command before
            it.
    """

    def __init__(self, limits: LimitSettings, *, on_change: Callable[[StateChange], None] | None = None) -> None:
        self.state = State.WAITING
        self.inputs: Inputs | None = None
        self.must_end_level = False
        self._limits = limits
        self._on_change = on_change
        self._seen_disarmed = limits.join_armed
        self._entered = self._last_step = -math.inf
        self._fault_time = 0.0
        self._reached_goal = 0
        self._last_change: StateChange | None = None

    @property
    def refusal(self) -> str:
        """See `StateChange`."""
        return "" if self._last_change is None else self._last_change.refusal

    @property
    def reaction(self) -> Reaction:
        """The reaction that is due now."""
        return reaction_to(self.state, self.active_faults())

    def active_faults(self) -> tuple[Cause, ...]:
        """Return the faults found by the newest step, the most severe first."""
        return () if self.inputs is None else find_faults(self.inputs, self._limits)

    def missing(self) -> tuple[Cause, ...]:
        """Return the causes that prevent flying: the faults and, unless it flies, those that prevent READY."""
        if self.inputs is None or self.state in (State.FLYING, State.ARRIVED):
            return self.active_faults()
        not_ready = [cause for cause in NOT_READY if cause_applies(cause, self.inputs, self._limits)]
        return (*self.active_faults(), *not_ready)

    def step(self, now: float, inputs: Inputs) -> Reaction:
        """Process the inputs of one tick at the time `now` [s] and return the reaction that is due."""
        # Before the first heartbeat it is unknown whether the motors are armed.
        self._seen_disarmed |= not inputs.armed and math.isfinite(inputs.heartbeat_age)
        self._count_faults(now)
        self.inputs = dataclasses.replace(
            inputs,
            seen_disarmed=self._seen_disarmed,
            state_time=now - self._entered,
            fault_time=self._fault_time,
            goal_new=inputs.goal_number != self._reached_goal,
            estimate_was_poor=Cause.ESTIMATE_POOR in self.active_faults(),
            cloud_drifted=Cause.CLOUD_DRIFTS in self.active_faults(),
            link_was_late=Cause.LINK_LATE in self.active_faults(),
        )
        target, cause = next_state(self.state, self.inputs, self._limits)
        self.must_end_level = target is not self.state and self._must_end_level(self.state, target, inputs)
        if cause is not None:
            change = StateChange(now, self.state, target, cause)
            self.state, self._entered, self._last_change = target, now, change
            if cause is Cause.GOAL_REACHED:
                self._reached_goal = inputs.goal_number
            if self._on_change is not None:
                self._on_change(change)
        return self.reaction

    def _count_faults(self, now: float) -> None:
        """Count the time with faults since the last step."""
        passed, self._last_step = now - self._last_step, now
        if self.state in (State.FLYING, State.ARRIVED):
            self._fault_time = max(self._fault_time - _FORGIVENESS * passed, 0.0)
        elif self.state in (State.WITHDRAWING, State.BRAKING, State.HOLDING):
            self._fault_time += passed
        else:
            self._fault_time = 0.0

    def _must_end_level(self, source: State, target: State, inputs: Inputs) -> bool:
        if cause_applies(Cause.LOOP_TIMEOUT, inputs, self._limits):
            # The watchdog or the failsafe process has sent that command, and the reported mode may be an old one.
            return False
        if not inputs.supported:
            return False
        if source in COMMANDING:
            return target is State.HANDED_BACK and inputs.armed and inputs.offboard
        is_flying = inputs.armed and inputs.in_air is not False
        return source in MAYBE_COMMANDING and target is State.WAITING and is_flying
