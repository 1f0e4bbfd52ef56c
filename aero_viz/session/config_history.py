"""The configurations of a session in order, with undo and redo. Safe to use from any thread."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from typing import Any

from aero_planner import PlannerConfig

__all__ = ["ConfigHistory"]

_DRAG = 1.0
"""Changes of the same parameters at shorter intervals are one step of undo: a slider being drawn [s]."""


class ConfigHistory:
    """Immutable configurations, swapped whole; the version counts the swaps."""

    def __init__(self, config: PlannerConfig) -> None:
        self._configs = [config]
        self._index = 0
        self._version = 0
        self._last: tuple[frozenset[str], float] = (frozenset(), 0.0)
        self._lock = threading.Lock()

    @property
    def present(self) -> tuple[PlannerConfig, int]:
        """The present configuration and its version."""
        with self._lock:
            return self._configs[self._index], self._version

    def change(self, change: PlannerConfig | Mapping[str, Any]) -> PlannerConfig:
        """Use a configuration, or the present one with some parameters changed, and return it.

        Raises:
            ValueError: a parameter is unknown or out of its bounds; the present configuration stays.
        """
        with self._lock:
            now = self._configs[self._index]
            config = change if isinstance(change, PlannerConfig) else now.replace(change)
            if config == now:
                return now
            paths = frozenset() if isinstance(change, PlannerConfig) else frozenset(change)
            goes_on = bool(paths) and self._last[0] == paths and time.monotonic() - self._last[1] < _DRAG
            self._last = (paths, time.monotonic())
            del self._configs[self._index + 1 :]
            if goes_on:
                self._configs[self._index] = config
            else:
                self._configs.append(config)
                self._index += 1
            self._version += 1
            return config

    def go(self, step: int) -> PlannerConfig:
        """Go back by -1 or forth by +1, within what is there, and return the configuration."""
        with self._lock:
            self._index = min(max(self._index + step, 0), len(self._configs) - 1)
            self._version += 1
            self._last = (frozenset(), 0.0)
            return self._configs[self._index]

    def drop(self, failed: PlannerConfig, good: PlannerConfig) -> None:
        """Forget a configuration that cannot be used. Where it is the present one, `good` is in its place."""
        with self._lock:
            now, present = self._index, self._configs[self._index]
            wanted = good if present == failed else present
            configs = [config for config in self._configs if config != failed]
            if wanted not in configs:
                configs.insert(now, wanted)
            places = [i for i, config in enumerate(configs) if config == wanted]
            index = min(places, key=lambda i: abs(i - now))
            self._version += configs[index] is not present
            self._configs, self._index = configs, index
            self._last = (frozenset(), 0.0)
