"""The viewer's end of the channel that changes parameters of a drone in flight."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from aero_planner.config import ParameterInfo, Value
from aero_planner.onboard.sealed_channel import SealedChannel, new_nonce
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.telemetry_protocol import Kind, Message, encode
from aero_planner.onboard.tuning import AGE_MAX
from aero_planner.onboard.tuning_limits import tunable_parameters
from aero_viz.errors import UserError
from aero_viz.session.frame import Notice

_NO_KEY = (
    "The page only watches. Who holds the key of the node's tuning.key_file can change parameters: connect with --key."
)
_NO_TUNING = "Nothing can be changed: the node has no tuning.key_file."
_NO_LIMITS = "Nothing can be changed: tuning.limits of the node allows nothing."
_NOT_YET = "The node has not accepted the key yet."


@dataclass(frozen=True)
class DroneParameters:
    """What the node has said about its parameters."""

    version: int = 0
    """Number of changes since the node started."""
    values: Mapping[str, Value] = field(default_factory=dict)
    """Values of those that may be changed, by path."""
    armed: bool = True
    can_undo: bool = False
    at_takeoff: bool = True
    """True if all are as they were at take-off."""
    time: float = 0.0
    """When it was said, host time of the node [s]."""
    obstacle: str = _NOT_YET
    """Why nothing can be changed; empty if it can."""
    pending: str = ""
    """What was asked for and has no answer yet."""
    refused: str = ""
    """Why the last change was refused; empty if it was not."""


class DroneTuning:
    """Asks the node for changes, and follows what it says. Safe from any thread.

    Args:
        greeting: the node's first message.
        onboard: settings of the node.
        key: the key; None only watches.
        send: sends bytes to the node.

    Attributes:
        tunable: parameters that may be changed, by path, with their bounds.
        state: what the node has said.

    Raises:
        ValueError: the greeting is malformed.
    """

    def __init__(
        self, greeting: Mapping[str, Any], onboard: OnboardConfig, key: bytes | None, send: Callable[[bytes], object]
    ) -> None:
        self.tunable: Mapping[str, ParameterInfo] = tunable_parameters(onboard.tuning.limits)
        self.state = DroneParameters()
        self._send = send
        self._channel: SealedChannel | None = None
        self._asked: tuple[int, float] | None = None
        """Number of the request without an answer, and the node's time to which it answered."""
        self._heard = time.monotonic()
        self._lock = threading.Lock()
        nonce = greeting.get("nonce")
        if nonce is None or not self.tunable or key is None:
            obstacle = _NO_TUNING if nonce is None else _NO_KEY if self.tunable else _NO_LIMITS
            self.state = replace(self.state, obstacle=obstacle)
            return
        own = new_nonce()
        self._channel = SealedChannel(key, nonce, own, is_node=False)
        send(encode(Kind.REQUEST, {**self._channel.seal({}), "nonce": own}))

    def change(self, changes: Mapping[str, Value], *, confirmed: bool = False) -> None:
        """Ask for other values, by path; `confirmed` if the drone may be armed.

        Raises:
            UserError: nothing can be sent now; says why.
        """
        values = self.state.values
        words = ", ".join(f"{path} {values.get(path)} → {value}" for path, value in changes.items())
        self._ask(words, {"changes": dict(changes), "confirmed": confirmed})

    def undo(self) -> None:
        """Ask for the parameters before the last change; raises as `change`."""
        self._ask("undo", {"step": "undo"})

    def back_to_takeoff(self) -> None:
        """Ask for the parameters with which the drone took off; raises as `change`."""
        self._ask("back to take-off", {"step": "takeoff"})

    def receive(self, message: Message) -> list[Notice]:
        """Take a status of the node, and return what the user should know.

        Raises:
            ValueError, KeyError, TypeError: the status is malformed.
        """
        values: Mapping[str, Any] = message.values
        with self._lock:
            if self._channel is not None:
                if values.get("denied"):
                    return self._lose_key(str(values["denied"]))
                try:
                    values = self._channel.open(values)
                except ValueError:
                    return []  # before the node has accepted the key, or from somebody else
            self._heard = time.monotonic()
            before = self.state
            self.state = replace(
                before,
                version=int(values["version"]),
                values=dict(values["values"]),
                armed=values["armed"] is not False,
                can_undo=values["can_undo"] is True,
                at_takeoff=values["at_takeoff"] is True,
                time=float(values["time"]),
                obstacle="" if self._channel is not None else before.obstacle,
            )
            return [*self._news(before), *self._answer(values)]

    def _news(self, before: DroneParameters) -> list[Notice]:
        notices = []
        if before.obstacle == _NOT_YET and not self.state.obstacle:
            notices.append(Notice("info", "The drone has accepted the key: its parameters can be changed."))
        if before.values and before.values != self.state.values:
            words = ", ".join(
                f"{path} {before.values.get(path)} → {value}"
                for path, value in self.state.values.items()
                if value != before.values.get(path)
            )
            notices.append(Notice("info", f"The drone's parameters, version {self.state.version}: {words}"))
        return notices

    def _answer(self, values: Mapping[str, Any]) -> list[Notice]:
        """Take the answer to what was asked for, if it has come."""
        if self._asked is None:
            return []
        number, asked_at = self._asked
        if values["request"] == number and values["waits"] is False:
            refused = str(values["refused"])
        elif values["request"] != number and self.state.time - asked_at > AGE_MAX:
            refused = "it was lost on the way."  # the node would not take it any more
        else:
            return []
        self._asked = None
        self.state = replace(self.state, pending="", refused=refused)
        return [Notice("error", f"The drone has changed nothing: {refused}")] if refused else []

    def _lose_key(self, reason: str) -> list[Notice]:
        self._channel = self._asked = None
        obstacle = f"The node does not accept the key ({reason}): check --key and tuning.key_file, and connect again."
        self.state = replace(self.state, obstacle=obstacle, pending="")
        return [Notice("error", obstacle)]

    def _ask(self, words: str, content: Mapping[str, Any]) -> None:
        with self._lock:
            state, silence = self.state, time.monotonic() - self._heard
            if state.obstacle or self._channel is None:
                raise UserError(state.obstacle)
            if self._asked is not None:
                raise UserError(f"The drone has not answered yet: {state.pending}.")
            if silence > AGE_MAX:
                raise UserError(f"The link has been silent for {silence:.0f} s; nothing was sent.")
            sealed = self._channel.seal({**content, "time": state.time, "version": state.version})
            try:
                self._send(encode(Kind.REQUEST, sealed))
            except OSError as error:
                raise UserError(f"The link is lost; nothing was sent: {error.strerror or error}.") from error
            self._asked = sealed["counter"], state.time
            self.state = replace(state, pending=words, refused="")
