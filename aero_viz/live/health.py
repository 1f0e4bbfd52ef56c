"""What the messages of one topic tell about its publisher: rate, clock, drops, and messages that cannot be used."""

from __future__ import annotations

import re
import struct
import time
from collections import Counter, deque

import numpy as np

from aero_viz.recordings.findings import GAP
from aero_viz.recordings.ros_messages import TF_TYPES

_WINDOW = 200
"""Newest messages from which rates and offsets are computed."""
_SILENT = 5.0
"""Median periods without a message after which a topic is silent, and at least a second."""
_OFFSET = 0.5
"""Difference of clocks from which it is reported [s]: no message takes as long."""
_RECENT = 10.0
"""Time for which trouble is reported [s]; the counts stay."""


def header_stamp(data: bytes, type_name: str) -> int:
    """Return the stamp in the header of a CDR message [ns], zero where it is unset or the message too short.

    It is zero for TF, too: its many publishers have times of their own, which do not follow one another.
    """
    if type_name in TF_TYPES or len(data) < 12:
        return 0
    seconds, nanoseconds = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    return seconds * 10**9 + nanoseconds


class TopicHealth:
    """Counts and clocks of one topic. Written by one thread; any thread may read."""

    def __init__(self, topic: str, type_name: str) -> None:
        self.topic, self.type = topic, type_name
        self.count = 0
        """Number of messages."""
        self.unused: Counter[str] = Counter()
        """Number of messages that could not be used, by reason; reasons that differ in their numbers count as one."""
        self.missing = 0
        """Number of messages that are missing, judged by the gaps between stamps."""
        self.behind = 0
        """Number of messages with a stamp that is not later than the one before."""
        self.publishers: tuple[str, ...] = ()
        """Names of the nodes that publish it, where they are known."""
        self._reasons: dict[str, str] = {}
        """First reason of each kind."""
        self._seen: dict[str, int] = {}
        """Number of messages when each kind of trouble was last seen."""
        self._arrivals: deque[int] = deque(maxlen=_WINDOW)
        self._stamps: deque[int] = deque(maxlen=_WINDOW)

    def add(self, stamp: int, arrival: int) -> None:
        """Count a message by its stamp, 0 where unset, and its arrival [ns]."""
        if self._stamps and stamp:
            step, period = (stamp - self._stamps[-1]) * 1e-9, self.period
            if step <= 0.0:
                self.behind += 1
                self._note("behind")
            if len(self._stamps) > 4 and period and GAP * period < step < 60.0:
                self.missing += round(step / period) - 1
                self._note("missing")
        self.count += 1
        self._arrivals.append(arrival)
        self._stamps.append(stamp)

    def interrupt(self) -> None:
        """Judge what comes as if it were the first messages; the counts stay."""
        self._arrivals.clear()
        self._stamps.clear()

    def refuse(self, reason: str) -> None:
        """Count a message that cannot be used, for a reason that completes "It cannot be used because ..."."""
        reason = self._reasons.setdefault(re.sub(r"\d+", "0", reason), reason)
        self.unused[reason] += 1
        self._note(reason)

    def _note(self, trouble: str) -> None:
        self._seen[trouble] = self.count

    def _is_recent(self, trouble: str) -> bool:
        """Return True if a kind of trouble was seen among the messages of the last `_RECENT` seconds."""
        since = (self.count - self._seen.get(trouble, -_WINDOW * 1000)) * self.period
        return since < _RECENT

    @property
    def period(self) -> float:
        """Median time between two messages [s], by their stamps where these are set; zero where it is unknown."""
        times = self._stamps if all(self._stamps) else self._arrivals
        return float(np.median(np.diff(np.array(times, np.int64)))) * 1e-9 if len(times) > 1 else 0.0

    @property
    def offset(self) -> float | None:
        """Least time from a stamp to its arrival [s]: the delay, and how far the publisher's clock is behind."""
        pairs = [(a - s) * 1e-9 for a, s in zip(tuple(self._arrivals), tuple(self._stamps), strict=False) if s]
        return min(pairs) if pairs else None

    def age(self, now: int) -> float:
        """Return the time since the newest message [s], infinite before the first."""
        return (now - self._arrivals[-1]) * 1e-9 if self._arrivals else float("inf")

    def is_silent(self, now: int) -> bool:
        """Return True if the topic has ended, or pauses."""
        return self.age(now) > max(_SILENT * self.period, 1.0)

    def sentences(self, now: int) -> list[str]:
        """Return what the user should know of the topic, one sentence without a full stop each."""
        found = []
        if self._arrivals and self.is_silent(now):
            found.append(f"{self.topic} is silent for {self.age(now):.0f} s: its publisher has ended, or is not heard")
        for reason, count in self.unused.most_common(3):
            if not self._is_recent(reason):
                continue
            found.append(f"{count} of {self.count} messages on {self.topic} are left out because {reason}")
        if self.missing and self._is_recent("missing"):
            found.append(f"about {self.missing} messages on {self.topic} are missing, by the gaps between stamps")
        if self.behind and self._is_recent("behind"):
            found.append(f"{self.behind} stamps on {self.topic} are not later than the one before")
        if len(self.publishers) > 1 and self.type not in TF_TYPES:
            found.append(f"{len(self.publishers)} nodes publish {self.topic}: {', '.join(self.publishers)}")
        offset = self.offset
        if offset is not None and abs(offset) > _OFFSET:
            which = "behind" if offset > 0.0 else "ahead of"
            found.append(f"the stamps on {self.topic} are {abs(offset):.1f} s {which} this computer's clock")
        return found


class ArrivalClock:
    """Wall time that never jumps: the system's at the start, and the monotonic clock from there."""

    def __init__(self) -> None:
        self._base = time.time_ns() - time.monotonic_ns()

    def now(self) -> int:
        """Return the time [ns]."""
        return self._base + time.monotonic_ns()
