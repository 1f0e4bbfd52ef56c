"""History of a session's configurations, with undo and redo. Safe to use from any thread."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from aero_planner.config import DroneConfig
from aero_viz.session.world_history import NEVER

DRAG_INTERVAL = 2.0
"""Changes of the same parameters within this time are one step of undo, as when a slider is dragged [s]."""
_MOST = 500
"""Largest number of configurations that are kept; the oldest one is dropped first."""


@dataclass(frozen=True, eq=False)
class _Entry:
    config: DroneConfig
    changed_at: float = NEVER
    """When it replaced the one before it [s]."""
    undone_at: float = NEVER
    """When it was left by an undo [s]."""


class ConfigHistory:
    """Immutable configurations, each replaced as a whole. The version counts the replacements."""

    def __init__(self, config: DroneConfig) -> None:
        self._entries = [_Entry(config)]
        self._index = 0
        self._version = 0
        self._last: tuple[frozenset[str], float] = (frozenset(), 0.0)
        self._lock = threading.Lock()

    @property
    def current(self) -> tuple[DroneConfig, int]:
        """The current configuration and its version."""
        with self._lock:
            return self._entries[self._index].config, self._version

    @property
    def changed_at(self) -> float:
        """Time of the change that `go(-1)` would undo [s], `time.monotonic`."""
        with self._lock:
            return self._entries[self._index].changed_at

    @property
    def undone_at(self) -> float:
        """Time at which the change that `go(1)` would redo was undone [s], `time.monotonic`; `NEVER` if there is
        none."""
        with self._lock:
            return max((entry.undone_at for entry in self._entries[self._index + 1 : self._index + 2]), default=NEVER)

    def change(self, change: DroneConfig | Mapping[str, Any]) -> DroneConfig:
        """Use another configuration, or change some parameters of the current one, and return the result.

        Raises:
            ValueError: a parameter is unknown or out of its bounds; the current configuration stays.
        """
        with self._lock:
            current = self._entries[self._index].config
            config = change if isinstance(change, DroneConfig) else current.replace(change)
            if config == current:
                return current
            paths = frozenset() if isinstance(change, DroneConfig) else frozenset(change)
            is_same_drag = bool(paths) and self._last[0] == paths and time.monotonic() - self._last[1] < DRAG_INTERVAL
            self._last = (paths, time.monotonic())
            del self._entries[self._index + 1 :]
            if is_same_drag:
                self._entries[self._index] = _Entry(config, time.monotonic())
            else:
                self._entries = [*self._entries, _Entry(config, time.monotonic())][-_MOST:]
                self._index = len(self._entries) - 1
            self._version += 1
            return config

    def go(self, step: int) -> DroneConfig:
        """Undo (-1) or redo (+1) one change, if there is one, and return the resulting configuration."""
        with self._lock:
            self._entries[self._index] = replace(self._entries[self._index], undone_at=time.monotonic())
            self._index = min(max(self._index + step, 0), len(self._entries) - 1)
            self._version += 1
            self._last = (frozenset(), 0.0)
            return self._entries[self._index].config

    @contextlib.contextmanager
    def converted(self, function: Callable[[DroneConfig], DroneConfig]) -> Iterator[None]:
        """Replace every configuration by the result of `function`, which cannot be undone, unless the context fails.

        A configuration for which `function` raises ValueError stays. If the context fails, all are as they were before.
        """
        with self._lock:
            before = list(self._entries), self._index
            entries = list(self._entries)
            for i, entry in enumerate(entries):
                with contextlib.suppress(ValueError):
                    entries[i] = replace(entry, config=function(entry.config))
            self._set(entries, self._index)
        try:
            yield
        except BaseException:
            with self._lock:
                self._set(*before)
            raise

    def _set(self, entries: list[_Entry], index: int) -> None:
        old, new = self._entries[self._index].config, entries[index].config
        self._entries, self._index = entries, index
        self._version += new != old
        self._last = (frozenset(), 0.0)

    def drop(self, failed: DroneConfig, good: DroneConfig) -> None:
        """Remove a configuration that cannot be used. If it is the current one, `good` replaces it."""
        with self._lock:
            old_index, old = self._index, self._entries[self._index].config
            new = good if old == failed else old
            entries = [entry for entry in self._entries if entry.config != failed]
            if all(entry.config != new for entry in entries):
                entries.insert(old_index, _Entry(new))
            indices = [i for i, entry in enumerate(entries) if entry.config == new]
            index = min(indices, key=lambda i: abs(i - old_index))
            self._version += entries[index].config is not old
            self._entries, self._index = entries, index
            self._last = (frozenset(), 0.0)
