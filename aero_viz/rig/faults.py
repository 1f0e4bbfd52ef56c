"""Faults that the rig injects: in the network, in the sensors and in the onboard computer."""

from __future__ import annotations

import heapq
import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from aero_viz.errors import UserError


@dataclass(frozen=True)
class FaultKind:
    """A kind of fault, with its default values."""

    help: str
    amount: float = 0.0
    """Default amount: a probability, a time [s] or a speed [m/s]; 0 if the kind has none."""
    duration: float = 0.0
    """Default duration [s]; 0 if the fault is instantaneous."""

    def form(self, name: str) -> str:
        """Return how a fault of this kind is written, such as pause-node@TIME[+DURATION]."""
        return f"{name}{'[=AMOUNT]' if self.amount else ''}@TIME{'[+DURATION]' if self.duration else ''}"


FAULT_KINDS: dict[str, FaultKind] = {
    "drop": FaultKind("packets of all kinds are lost in both directions", 0.3, 3.0),
    "delay": FaultKind("packets arrive late, by up to twice the amount [s]", 0.05, 3.0),
    "duplicate": FaultKind("packets arrive twice", 0.3, 3.0),
    "reorder": FaultKind("packets overtake each other", 0.3, 3.0),
    "corrupt": FaultKind("bytes of packets are changed", 0.3, 3.0),
    "freeze-state": FaultKind("the autopilot repeats one state", duration=3.0),
    "lose-position": FaultKind("the autopilot's position drifts and grows uncertain", duration=60.0),
    "err-velocity": FaultKind("the autopilot's velocity is off to the west, and its position drifts", 0.6, 60.0),
    "lose-transmitter": FaultKind("the autopilot no longer hears the pilot's transmitter", duration=60.0),
    "low-battery": FaultKind("the autopilot warns of a low battery"),
    "take-over": FaultKind("the pilot switches to HOLD, then back to OFFBOARD", duration=2.0),
    "kill-sensor": FaultKind("the LiDAR sends nothing", duration=60.0),
    "pause-node": FaultKind("the node's process is paused, then resumed", duration=0.5),
    "kill-node": FaultKind("the node's process is killed"),
    "restart-node": FaultKind("the node's process is killed and restarted"),
}
"""Kinds of faults by name."""

OWN_FAULTS = ("err-velocity",)
"""Kinds of faults that only the rig's own autopilot has."""

_MAX_VALUE = 1e6

NETWORK_FAULTS = ("drop", "delay", "duplicate", "reorder", "corrupt")
"""Kinds of faults that affect a `Channel`."""


@dataclass(frozen=True)
class Fault:
    """One fault during a flight.

    Args:
        kind: name in FAULT_KINDS.
        at: time when the fault begins, after the engagement [s].
        duration: duration [s]; None is the default of the kind.
        amount: probability, time [s] or speed [m/s]; None is the default of the kind.

    Raises:
        UserError: the kind does not exist or has no such value, or a value is out of range.
    """

    kind: str
    at: float
    duration: float | None = None
    amount: float | None = None

    def __post_init__(self) -> None:
        if self.kind not in FAULT_KINDS:
            raise UserError(f"There is no fault {self.kind!r}; the kinds are {', '.join(FAULT_KINDS)}.")
        kind = FAULT_KINDS[self.kind]
        for name in ("duration", "amount"):
            default = getattr(kind, name)
            if getattr(self, name) is None:
                object.__setattr__(self, name, default)
            elif getattr(self, name) and not default:
                raise UserError(f"The fault {self.kind} has no {name}; write {kind.form(self.kind)}.")
        for name, value in (("time", self.at), ("duration", self.duration), ("amount", self.amount)):
            if value is None or not 0.0 <= value < _MAX_VALUE:
                raise UserError(f"The {name} of the fault {self.kind} is {value}; it must be in [0, {_MAX_VALUE:g}).")
        if self.kind in NETWORK_FAULTS and self.kind != "delay" and (self.amount or 0.0) > 1.0:
            raise UserError(f"The amount of the fault {self.kind} is {self.amount:g}; it is a probability, at most 1.")

    @property
    def end(self) -> float:
        """Time when the fault ends, after the engagement [s]."""
        return self.at + (self.duration or 0.0)

    def __str__(self) -> str:
        amount = f" of {self.amount:g}" if FAULT_KINDS[self.kind].amount else ""
        duration = f" for {self.duration:g} s" if FAULT_KINDS[self.kind].duration else ""
        return f"{self.kind}{amount}{duration}"


def parse_fault(text: str) -> Fault:
    """Return the fault that a text describes.

    Args:
        text: KIND[=AMOUNT]@TIME[+DURATION], such as drop=0.2@3+2 or pause-node@4.

    Raises:
        UserError: the text has another form, the kind does not exist or has no such value, or a value is out of range.
    """
    number = r"[0-9]*\.?[0-9]+"
    match = re.fullmatch(rf"([a-z-]+)(?:=({number}))?@({number})(?:\+({number}))?", text)
    if match is None:
        form = "KIND=AMOUNT@TIME+DURATION, such as drop=0.2@3+2 or pause-node@4"
        raise UserError(f"{text!r} is not a fault; write {form}.")
    kind, amount, at, duration = match.groups()
    return Fault(kind, float(at), float(duration) if duration else None, float(amount) if amount else None)


class Channel:
    """A network connection for datagrams. It delivers them at once unless faults are active.

    Args:
        deliver: called with each datagram that arrives.
        seed: seed of the random faults.

    Attributes:
        faults: amounts of the active NETWORK_FAULTS by kind.
    """

    _REORDER_DELAY = 0.02  # [s], the longest delay of a reordered datagram

    def __init__(self, deliver: Callable[[bytes], object], *, seed: int = 0) -> None:
        self.faults: dict[str, float] = {}
        self._deliver = deliver
        self._random = np.random.default_rng([seed, 0x77697265])
        self._delayed: list[tuple[float, int, bytes]] = []  # heap of due time, sequence number and datagram
        self._count = 0

    def put(self, data: bytes, now: float) -> None:
        """Send a datagram at the time `now` [s]."""
        if not self.faults and not self._delayed:
            self._deliver(data)
            return
        if self._strikes("drop"):
            return
        for _ in range(2 if self._strikes("duplicate") else 1):
            datagram = self._corrupted(data) if self._strikes("corrupt") else data
            due = now + self.faults.get("delay", 0.0) * float(self._random.uniform(0.0, 2.0))
            if self._strikes("reorder"):
                due += self._REORDER_DELAY * float(self._random.uniform())
            self._count += 1
            heapq.heappush(self._delayed, (due, self._count, datagram))
        self.flush(now)

    def flush(self, now: float) -> None:
        """Deliver the datagrams that are due at the time `now` [s]."""
        while self._delayed and self._delayed[0][0] <= now:
            self._deliver(heapq.heappop(self._delayed)[2])

    def _strikes(self, kind: str) -> bool:
        return kind in self.faults and bool(self._random.uniform() < self.faults[kind])

    def _corrupted(self, data: bytes) -> bytes:
        result = bytearray(data)
        for _ in range(int(self._random.integers(1, 9))):
            result[int(self._random.integers(len(result)))] ^= int(self._random.integers(1, 256))
        return bytes(result)
