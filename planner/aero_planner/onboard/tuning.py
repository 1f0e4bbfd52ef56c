"""Changes of the planner's live parameters while the node runs: checked here, and taken between two plans."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from aero_planner.config import PlannerConfig
from aero_planner.onboard.agreement import check_together
from aero_planner.onboard.interfaces import ConfigChange, Observation, Observer, VehicleSample
from aero_planner.onboard.safety_machine import StateChange
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.tuning_limits import check_changes, tunable_parameters

_log = logging.getLogger(__name__)

AGE_MAX = 2.0
"""Age of the status to which a request answers, from which it comes too late [s]."""
UNCONFIRMED = "the drone is armed, and the change was not confirmed."
"""Answer to a request that would be taken if it were confirmed."""
_UNDO_MAX = 100
"""Number of earlier configurations that are kept."""
_STEPS = ("takeoff", "undo")


@dataclass(eq=False)
class Request:
    """A change that somebody asks for."""

    number: int
    """Number by which the sender knows the answer."""
    sender: str
    content: Mapping[str, Any]
    """`time` and `version` of the status to which it answers; `changes`, values by path, or `step`, "undo" or
    "takeoff"; `confirmed`, True to change an armed drone."""
    answer: str | None = None
    """None while the request waits, "" once it was taken, otherwise why it was refused."""
    abandoned: bool = False
    """True if the connection to the sender is gone, or the sender asks for something else."""


class Tuning(Observer):
    """The planner's configuration on the drone, and the one change that may wait for the next plan.

    The control thread calls `observe`, the planning thread `take`, and whoever talks to viewers or ROS the rest.

    Args:
        planner: configuration with which the node starts.
        onboard: settings of the node; `onboard.tuning.limits` says what may change.
        key: key of those who may ask for changes.
        clock: host time [s].

    Attributes:
        key: see the arguments.
        tunable: parameters that may change, by path, with their bounds.
        config: configuration in use, before the replanner's own limit of the speed.
        version: number of changes so far.
    """

    def __init__(
        self,
        planner: PlannerConfig,
        onboard: OnboardConfig,
        key: bytes,
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.key = key
        self.config, self.version = planner, 0
        self._onboard, self._clock = onboard, clock
        self.tunable = tunable_parameters(onboard.tuning.limits)
        self._earlier: list[PlannerConfig] = []
        self._takeoff = planner
        self._waiting: Request | None = None
        self._armed = True  # until a sample says otherwise
        self._safety: StateChange | None = None
        self._lock = threading.Lock()

    def observe(self, item: Observation) -> None:
        """Follow whether the drone is armed and what the node does."""
        if isinstance(item, StateChange):
            self._safety = item
        elif isinstance(item, VehicleSample):
            if item.armed and not self._armed:
                self._takeoff = self.config
            self._armed = item.armed

    def status(self, request: Request | None) -> dict[str, Any]:
        """Return what a viewer is told, whose last request is `request`."""
        with self._lock:
            return {
                "time": self._clock(),
                "version": self.version,
                "values": {path: self.config.get(path) for path in self.tunable},
                "armed": self._armed,
                "can_undo": bool(self._earlier),
                "at_takeoff": self.config == self._takeoff,
                "request": 0 if request is None else request.number,
                "waits": request is not None and request.answer is None,
                "refused": "" if request is None else request.answer or "",
            }

    def submit(self, request: Request) -> None:
        """Let a request wait for the next plan; one that is not possible is answered with the reason."""
        with self._lock:
            try:
                self._wanted(request)
                if self._waiting is not None and not self._waiting.abandoned:
                    raise ValueError("another change waits for the next plan; try again.")
            except ValueError as error:
                self._refuse(request, error)
            else:
                self._waiting = request

    def take(self, configure: Callable[[PlannerConfig], None]) -> ConfigChange | None:
        """Pass the configuration that was asked for to `configure`; return None if there is none, or not any more."""
        if self._waiting is None:
            return None
        with self._lock:
            request, self._waiting = self._waiting, None
            try:
                config = self._wanted(request)
                configure(config)
            except (ValueError, RuntimeError) as error:
                self._refuse(request, error)
                return None
            before, self.config, self.version = self.config, config, self.version + 1
            if request.content.get("step") == "undo":
                self._earlier.pop()
            else:
                self._earlier = [*self._earlier, before][-_UNDO_MAX:]
            request.answer = ""
            change = ConfigChange(self._clock(), self.version, config)
        differences = before.differences(config).items()
        changes = ", ".join(f"{path} {old} -> {new}" for path, (old, new) in differences)
        _log.warning("parameters, version %d: %s, asked for by %s", change.version, changes, request.sender)
        return change

    def _wanted(self, request: Request) -> PlannerConfig:
        """Return the configuration that a request asks for.

        Raises:
            ValueError: it is malformed, is not allowed, comes too late, or the drone is not in a state for it.
        """
        content = request.content
        if request.abandoned:
            raise ValueError("its sender is gone.")
        seen = content.get("time")
        age = self._clock() - seen if isinstance(seen, float) else math.nan
        if not 0.0 <= age <= AGE_MAX:
            raise ValueError(f"it was under way for {age:.0f} s; look at the drone, and send it again.")
        if content.get("version") != self.version:
            raise ValueError("the parameters have changed meanwhile; look at them, and send it again.")
        if self._safety is not None and self._safety.refusal:
            raise ValueError(self._safety.refusal)
        step = content.get("step")
        if step == "takeoff":
            config = self._takeoff
        elif step == "undo":
            config = self._earlier[-1] if self._earlier else self.config
        else:
            config = self.config.replace(check_changes(content.get("changes"), self.tunable))
        if config == self.config:
            raise ValueError("nothing would change.")
        check_together(config, self._onboard)
        if step not in _STEPS and self._armed and content.get("confirmed") is not True:
            raise ValueError(UNCONFIRMED)
        return config

    def _refuse(self, request: Request, error: Exception) -> None:
        request.answer = str(error)
        _log.warning("a change of the parameters by %s was refused: %s", request.sender, error)
