"""The configurations of a session in order, with undo and redo. Safe to use from any thread."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

from aero_planner import PlannerConfig

__all__ = ["ConfigHistory"]


class ConfigHistory:
    """Immutable configurations, swapped whole; the version counts them."""

    def __init__(self, config: PlannerConfig) -> None:
        self._configs = [config]
        self._version = 0
        self._lock = threading.Lock()

    @property
    def present(self) -> tuple[PlannerConfig, int]:
        """The present configuration and its version."""
        with self._lock:
            return self._configs[self._version], self._version

    def change(self, change: PlannerConfig | Mapping[str, Any]) -> PlannerConfig:
        """Append a configuration, or the present one with some parameters changed, and return it.

        Raises:
            ValueError: a parameter is unknown or out of its bounds; the present configuration stays.
        """
        with self._lock:
            now = self._configs[self._version]
            config = change if isinstance(change, PlannerConfig) else now.replace(change)
            if config != now:
                del self._configs[self._version + 1 :]
                self._configs.append(config)
                self._version += 1
            return config

    def go(self, step: int) -> PlannerConfig:
        """Go back by -1 or forth by +1, within what is there, and return the configuration."""
        with self._lock:
            self._version = min(max(self._version + step, 0), len(self._configs) - 1)
            return self._configs[self._version]
