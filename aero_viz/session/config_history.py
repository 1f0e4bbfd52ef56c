"""History of a session's configurations, with undo and redo. Safe to use from any thread."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from typing import Any

from aero_planner import PlannerConfig

_DRAG_INTERVAL = 1.0
"""Changes of the same parameters within this time are one step of undo, as when a slider is dragged [s]."""
_MOST = 500
"""Number of configurations that are kept; the oldest one goes first."""


class ConfigHistory:
    """Immutable configurations, each replaced as a whole. The version counts the replacements."""

    def __init__(self, config: PlannerConfig) -> None:
        self._configs = [config]
        self._index = 0
        self._version = 0
        self._last: tuple[frozenset[str], float] = (frozenset(), 0.0)
        self._lock = threading.Lock()

    @property
    def current(self) -> tuple[PlannerConfig, int]:
        """The current configuration and its version."""
        with self._lock:
            return self._configs[self._index], self._version

    def change(self, change: PlannerConfig | Mapping[str, Any]) -> PlannerConfig:
        """Use another configuration, or change some parameters of the current one, and return the result.

        Raises:
            ValueError: a parameter is unknown or out of its bounds; the current configuration stays.
        """
        with self._lock:
            current = self._configs[self._index]
            config = change if isinstance(change, PlannerConfig) else current.replace(change)
            if config == current:
                return current
            paths = frozenset() if isinstance(change, PlannerConfig) else frozenset(change)
            is_same_drag = bool(paths) and self._last[0] == paths and time.monotonic() - self._last[1] < _DRAG_INTERVAL
            self._last = (paths, time.monotonic())
            del self._configs[self._index + 1 :]
            if is_same_drag:
                self._configs[self._index] = config
            else:
                self._configs = [*self._configs, config][-_MOST:]
                self._index = len(self._configs) - 1
            self._version += 1
            return config

    def go(self, step: int) -> PlannerConfig:
        """Undo (-1) or redo (+1) one change, if there is one, and return the resulting configuration."""
        with self._lock:
            self._index = min(max(self._index + step, 0), len(self._configs) - 1)
            self._version += 1
            self._last = (frozenset(), 0.0)
            return self._configs[self._index]

    def drop(self, failed: PlannerConfig, good: PlannerConfig) -> None:
        """Remove a configuration that cannot be used. If it is the current one, `good` replaces it."""
        with self._lock:
            old_index, old = self._index, self._configs[self._index]
            new = good if old == failed else old
            configs = [config for config in self._configs if config != failed]
            if new not in configs:
                configs.insert(old_index, new)
            indices = [i for i, config in enumerate(configs) if config == new]
            index = min(indices, key=lambda i: abs(i - old_index))
            self._version += configs[index] is not old
            self._configs, self._index = configs, index
            self._last = (frozenset(), 0.0)
