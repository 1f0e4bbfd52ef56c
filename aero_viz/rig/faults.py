"""What goes wrong on purpose: on the wires, in the sensors, and in the computer."""

from __future__ import annotations

import heapq
import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from aero_viz.errors import UserError

__all__ = ["FAULT_KINDS", "Channel", "Fault", "parse_fault"]


@dataclass(frozen=True)
class FaultKind:
    """What a kind of fault does."""

    help: str
    amount: float = 0.0
    """Where none is given: a probability or a time [s]; 0 where the kind takes none."""
    duration: float = 0.0
    """Where none is given [s]; 0 where the kind is a moment."""


FAULT_KINDS: dict[str, FaultKind] = {
    "drop": FaultKind("packets are lost, all kinds both ways", 0.3, 3.0),
    "delay": FaultKind("packets come late, by up to twice the amount [s]", 0.05, 3.0),
    "duplicate": FaultKind("packets come twice", 0.3, 3.0),
    "reorder": FaultKind("packets overtake each other", 0.3, 3.0),
    "corrupt": FaultKind("bytes of packets are changed", 0.3, 3.0),
    "freeze-state": FaultKind("the autopilot repeats one state", duration=3.0),
    "kill-sensor": FaultKind("the LiDAR is silent", duration=60.0),
    "pause-node": FaultKind("the node's process is stopped, then goes on", duration=0.5),
    "restart-node": FaultKind("the node's process is killed and started again"),
}
NETWORK = ("drop", "delay", "duplicate", "reorder", "corrupt")


@dataclass(frozen=True)
class Fault:
    """Something that goes wrong once.

    Args:
        kind: of FAULT_KINDS.
        at: when it begins, after the node was given the vehicle [s].
        duration: how long it lasts [s]; None is the kind's own.
        amount: how bad it is; None is the kind's own.
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
            if getattr(self, name) is None:
                object.__setattr__(self, name, getattr(kind, name))
        for name in ("at", "duration", "amount"):
            if not 0.0 <= getattr(self, name) < 1e6:
                raise UserError(
                    f"The {name} of the fault {self.kind} is {getattr(self, name)!r}; it must not be negative."
                )
        if self.kind in NETWORK and self.kind != "delay" and self.amount > 1.0:  # type: ignore[operator]
            raise UserError(f"The amount of the fault {self.kind} is {self.amount:g}; it is a probability, at most 1.")

    @property
    def end(self) -> float:
        """When it is over, after the node was given the vehicle [s]."""
        return self.at + (self.duration or 0.0)

    def __str__(self) -> str:
        amount = f" of {self.amount:g}" if FAULT_KINDS[self.kind].amount else ""
        duration = f" for {self.duration:g} s" if FAULT_KINDS[self.kind].duration else ""
        return f"{self.kind}{amount}{duration}"


def parse_fault(text: str) -> Fault:
    """Return the fault written as KIND@TIME, KIND@TIME+DURATION or KIND=AMOUNT@TIME+DURATION, such as drop=0.2@3+2.

    Raises:
        UserError: the text has another form, or the kind does not exist.
    """
    number = r"[0-9]*\.?[0-9]+"
    match = re.fullmatch(rf"([a-z-]+)(?:=({number}))?@({number})(?:\+({number}))?", text)
    if match is None:
        raise UserError(f"{text!r} is no fault; write KIND=AMOUNT@TIME+DURATION, such as drop=0.2@3+2 or pause-node@4.")
    kind, amount, at, duration = match.groups()
    return Fault(kind, float(at), float(duration) if duration else None, float(amount) if amount else None)


class Channel:
    """A wire that can be bad: passes datagrams on, at once while it is good.

    Args:
        deliver: takes a datagram.
        seed: of the bad luck.

    Attributes:
        active: amounts of the faults of NETWORK that are on now.
    """

    _OVERTAKEN = 0.02  # [s] that a reordered packet is held back

    def __init__(self, deliver: Callable[[bytes], object], *, seed: int = 0) -> None:
        self.active: dict[str, float] = {}
        self._deliver = deliver
        self._random = np.random.default_rng([seed, 0x77697265])
        self._late: list[tuple[float, int, bytes]] = []
        self._count = 0

    def put(self, data: bytes, now: float) -> None:
        """Send a datagram at the time `now` [s]."""
        if not self.active and not self._late:
            self._deliver(data)
            return
        if self._hit("drop"):
            return
        for _ in range(2 if self._hit("duplicate") else 1):
            part = self._corrupted(data) if self._hit("corrupt") else data
            due = now + self.active.get("delay", 0.0) * float(self._random.uniform(0.0, 2.0))
            if self._hit("reorder"):
                due += self._OVERTAKEN * float(self._random.uniform())
            self._count += 1
            heapq.heappush(self._late, (due, self._count, part))
        self.flush(now)

    def flush(self, now: float) -> None:
        """Deliver what is due at the time `now` [s]."""
        while self._late and self._late[0][0] <= now:
            self._deliver(heapq.heappop(self._late)[2])

    def _hit(self, kind: str) -> bool:
        return kind in self.active and bool(self._random.uniform() < self.active[kind])

    def _corrupted(self, data: bytes) -> bytes:
        result = bytearray(data)
        for _ in range(int(self._random.integers(1, 9))):
            result[int(self._random.integers(len(result)))] ^= int(self._random.integers(1, 256))
        return bytes(result)
