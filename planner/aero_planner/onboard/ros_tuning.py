"""Changes of the planner's parameters in flight from ROS 2, where they are set without a key or a second click."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from aero_planner.config import ParameterInfo, Value
from aero_planner.onboard.tuning import AGE_MAX, UNCONFIRMED, Request, Tuning

_CONFIRMING = (0.5, 5.0)
"""Time after a set within which the same one confirms it [s]: what a slider sends twice does not."""
_POLL = 0.01  # [s]
_SENDER = "ROS"


class RosTuning:
    """Asks for what is set in ROS 2, and waits for the answer. One thread may use it.

    Args:
        tuning: the parameters.
        clock, sleep: host time [s], and a wait in it.
    """

    def __init__(
        self,
        tuning: Tuning,
        *,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._tuning, self._clock, self._sleep = tuning, clock, sleep
        self._number = 0
        self._unconfirmed: tuple[int, dict[str, Any]] | None = None
        """Version of the parameters and changes of the set that was refused only since nothing confirmed it."""
        self._refused = 0.0

    def current(self) -> tuple[Sequence[ParameterInfo], Mapping[str, Value]]:
        """Return the parameters that may change, and their values in force by path."""
        return list(self._tuning.tunable.values()), self._tuning.status(None)["values"]

    def ask(self, changes: Mapping[str, Any]) -> None:
        """Change values, by path, between the next two plans. An armed drone takes the same change when it is repeated.

        Raises:
            ValueError: it was refused; says why.
        """
        status, wanted, age = self._tuning.status(None), dict(changes), self._clock() - self._refused
        if wanted.items() <= status["values"].items():
            return  # who loads a file sets again what is in force
        is_repeated = self._unconfirmed == (status["version"], wanted)
        is_confirmed = is_repeated and _CONFIRMING[0] <= age <= _CONFIRMING[1]
        self._number += 1
        content = {"time": status["time"], "version": status["version"], "changes": wanted, "confirmed": is_confirmed}
        request = Request(self._number, _SENDER, content)
        self._tuning.submit(request)
        answer = self._wait(request)
        if answer != UNCONFIRMED:
            self._unconfirmed = None
        elif not is_repeated or age > _CONFIRMING[1]:
            self._unconfirmed, self._refused = (status["version"], wanted), self._clock()
        if answer:
            hint = f" Set the same again within {_CONFIRMING[1]:g} s to confirm it." if self._unconfirmed else ""
            raise ValueError(answer + hint)

    def _wait(self, request: Request) -> str:
        deadline = self._clock() + AGE_MAX
        while request.answer is None and self._clock() < deadline:
            self._sleep(_POLL)
        if request.answer is None:
            request.abandoned = True
            return f"the node has taken no change for {AGE_MAX:g} s."
        return request.answer
