"""The node and the failsafe process's code in simulated time, in the rig's own process."""

from __future__ import annotations

import contextlib
import logging
import os
from collections.abc import Callable
from typing import Any

from numpy.typing import ArrayLike

from aero_planner import Planner, PlannerConfig
from aero_planner.onboard.connections import open_lidar, open_link
from aero_planner.onboard.failsafe_process import FailsafeGuard
from aero_planner.onboard.heartbeat_memory import HeartbeatMemory
from aero_planner.onboard.mavlink import MavlinkLink
from aero_planner.onboard.node import Node
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.telemetry import Telemetry
from aero_planner.onboard.tuning import Tuning
from aero_planner.onboard.watchdog import Heartbeat
from aero_planner.plan import Plan


class _MemoryFailsafe:
    """The node's side of the failsafe process, without the process."""

    lost = False
    interventions = 0

    def __init__(self, memory: HeartbeatMemory, link: MavlinkLink) -> None:
        self._memory, self._link = memory, link

    @property
    def braking(self) -> bool:
        return self._memory.read_status().braking

    def report(self, heartbeat: Heartbeat) -> None:
        self._memory.write(heartbeat, self._link.peer, self._link.min_signing_time)
        self.interventions = self._memory.read_status().interventions

    def close(self) -> None:
        pass


class _SlowPlanner:
    """A planner whose plans take simulated time."""

    def __init__(self, planner: Planner, advance: Callable[[float], None], plan_time: float) -> None:
        self.device = planner.device
        self.reserve_sweeps, self.reset, self.configure = planner.reserve_sweeps, planner.reset, planner.configure
        self._planner, self._advance, self._plan_time = planner, advance, plan_time

    @property
    def config(self) -> PlannerConfig:
        return self._planner.config

    def plan(self, *arguments: Any, **options: Any) -> Plan:
        plan = self._planner.plan(*arguments, **options)
        self._advance(self._plan_time)
        return plan


class _LogLines(logging.Handler):
    """Keeps the lines that the node logs."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())


class LockstepNode:
    """A node that is started, paused and killed like `aero_viz.rig.process.NodeProcess`, but does one step per call.

    Args:
        planner: the planner, which the caller closes.
        onboard: settings of the node.
        clock: simulated time [s].
        advance: lets simulated time pass [s] while the node plans. It calls `step` of this node again.
        goal: see `Node`.
        plan_time: duration of a plan [s].
        tuning_key: key of viewers who may change parameters, see `Tuning`; None serves no viewers.

    Attributes:
        telemetry: server of the viewers; None without a key, and before `start`.
        node: the node; None before `start`.
        runs: False while it is paused.
        lives: False before it is started, and after it was killed.
    """

    def __init__(
        self,
        planner: Planner,
        onboard: OnboardConfig,
        *,
        clock: Callable[[], float],
        advance: Callable[[float], None],
        goal: ArrayLike | None = None,
        plan_time: float = 0.02,
        tuning_key: bytes | None = None,
    ) -> None:
        self.node: Node | None = None
        self.telemetry: Telemetry | None = None
        self._tuning_key = tuning_key
        self.runs, self.lives = True, False
        self._planner, self._onboard, self._goal = planner, onboard, goal
        self._config = planner.config
        self._clock, self._advance, self._plan_time = clock, advance, plan_time
        self._control_period, self._plan_period = 1.0 / onboard.rates.control, 1.0 / onboard.rates.replan
        self._next_control = self._next_plan = self._next_guard = 0.0
        self._planning = False
        self._guards: list[FailsafeGuard] = []
        self._sockets = contextlib.ExitStack()
        self._log = _LogLines()
        self._logger = logging.getLogger("aero_planner")
        self._level = self._logger.level

    def start(self) -> None:
        """Start the node; it may be started again after it was killed."""
        self._logger.addHandler(self._log)
        self._logger.setLevel(logging.INFO)
        vehicle = self._config.vehicle
        self._planner.reset()
        self._planner.configure(self._config)  # a node that was killed may have limited its speed
        with contextlib.ExitStack() as stack:
            link = open_link(self._onboard, vehicle, clock=self._clock)
            stack.callback(link.close)
            source = open_lidar(self._onboard, clock=self._clock)
            stack.callback(source.close)
            file = HeartbeatMemory.create_file()
            memory, reader = HeartbeatMemory(file), HeartbeatMemory(file)
            os.close(file)
            self._guards.append(FailsafeGuard(reader, self._onboard, vehicle))
            tuning = None
            if self._tuning_key is not None:
                tuning = Tuning(self._config, self._onboard, self._tuning_key, clock=self._clock)
                self.telemetry = Telemetry(self._config, self._onboard, tuning=tuning, clock=self._clock)
                stack.callback(self.telemetry.close)
            self.node = Node(
                _SlowPlanner(self._planner, self._advance, self._plan_time),  # type: ignore[arg-type]
                link,
                source,
                self._onboard,
                goal=self._goal,
                clock=self._clock,
                observers=[observer for observer in (tuning, self.telemetry) if observer is not None],
                failsafe=_MemoryFailsafe(memory, link),
                tuning=tuning,
            )
            self._sockets = stack.pop_all()
        self.lives = True

    @property
    def running(self) -> bool:
        """True if it was started and was not killed."""
        return self.lives

    def pause(self) -> None:
        """Stop the node until `resume`, as SIGSTOP does."""
        self.runs = False

    def resume(self) -> None:
        """Let a paused node continue."""
        self.runs = True

    def kill(self) -> None:
        """End the node at once, as SIGKILL does; the failsafe process remains."""
        self.lives = False
        self._sockets.close()

    def log(self) -> list[str]:
        """Return the lines that the node has logged so far."""
        return self._log.lines

    def stop(self) -> None:
        """End the node."""
        if self.lives and self.node is not None:
            self.lives = False
            self.node.close()

    def close(self) -> None:
        """End the node and the failsafe process's code."""
        self.stop()
        self._planner.configure(self._config)
        for guard in self._guards:
            guard.close()
        self._guards.clear()
        self._logger.removeHandler(self._log)
        self._logger.setLevel(self._level)

    def step(self, now: float) -> None:
        """Run the loops that are due at the time `now` [s]."""
        if now >= self._next_control:
            self._next_control = max(self._next_control + self._control_period, now)
            if self.runs and self.lives and self.node is not None:
                self.node.control_once()
                self.node.watch_once()
        if now >= self._next_guard:
            self._next_guard = max(self._next_guard + self._control_period, now)
            for guard in self._guards:
                guard.check(now, is_alone=not (self.lives and guard is self._guards[-1]))
        if not self._planning and self.runs and self.lives and self.node is not None and now >= self._next_plan:
            self._planning = True
            self.node.plan_once()
            self._planning = False
            self._next_plan = max(self._next_plan + self._plan_period, self._clock())
