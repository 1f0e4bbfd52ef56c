"""Undo and redo of changes of a world. A change belongs to its tick, so the world of a tick decides which is undone."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from aero_viz.scenes import World

NEVER = float("-inf")
_MOST = 500
"""Largest number of changes that are kept; the oldest one is dropped first."""


@dataclass
class _Change:
    before: World
    after: World
    step: object
    changed_at: float
    undone_at: float = NEVER


class WorldHistory:
    """Worlds that were changed into one another. Times are those of `time.monotonic` [s]."""

    def __init__(self) -> None:
        # Replaced as a whole: other threads read it.
        self._changes: tuple[_Change, ...] = ()

    def note(self, before: World | None, after: World | None, *, step: object = None) -> None:
        """Note that a world was changed into another one; changes in a row with the same `step` are undone together."""
        if before is after or before is None or after is None:
            return
        last = self._made(before)
        for change in self._changes:
            if change.before is before:
                change.undone_at = NEVER
        start = before if last is None or step is None or last.step is not step else last.before
        self._changes = (*self._changes, _Change(start, after, step, time.monotonic()))[-_MOST:]

    def changed_at(self, world: World | None) -> float:
        """Return the time of the change that `undo` takes back from `world`; `NEVER` if there is none."""
        change = self._made(world)
        return NEVER if change is None else change.changed_at

    def undone_at(self, world: World | None) -> float:
        """Return the time at which the change that `redo` makes to `world` was undone; `NEVER` if there is none."""
        change = self._undone(world)
        return NEVER if change is None else change.undone_at

    def undo(self, source: Any) -> None:
        """Take back the change that made the world of a source, if there is one."""
        if (change := self._made(source.observe().world)) is not None:
            source.set_world(change.before)
            change.undone_at = time.monotonic()

    def redo(self, source: Any) -> None:
        """Redo the change of the world of a source that was undone last, if there is one."""
        if (change := self._undone(source.observe().world)) is not None:
            source.set_world(change.after)
            change.undone_at = NEVER

    def _made(self, world: World | None) -> _Change | None:
        return next((change for change in reversed(self._changes) if change.after is world), None)

    def _undone(self, world: World | None) -> _Change | None:
        undone = [change for change in self._changes if change.before is world and change.undone_at > NEVER]
        return max(undone, key=lambda change: change.undone_at, default=None)
