"""Parameters of the memory of sweeps."""

from __future__ import annotations

from dataclasses import dataclass

from aero_planner.parameters import ParameterSection, live

LONGEST_MEMORY = 12.0
"""Largest time for which sweeps are remembered [s]."""


@dataclass(frozen=True)
class Parameters(ParameterSection, section="memory"):
    """Memory: how long sweeps are kept."""

    memory_time: float = live(
        3.0, "s", 0.1, LONGEST_MEMORY, "Sweeps of a simulated flight that are older than this are forgotten. Of those "
        "before the newest ten, one point in five is kept. The onboard node has lidar.older_sweeps instead.",
        label="Memory",
    )  # fmt: skip
    memory_distance: float = live(
        9.0, "m", 0.0, 100.0, "A slow drone remembers for longer, since what leaves its field of view stays near: for "
        "the time in which it flies this distance at its speed limit, at most 12 s.",
        label="Memory of a slow drone",
    )  # fmt: skip

    def sweep_memory(self, speed_limit: float) -> float:
        return max(self.memory_time, min(self.memory_distance / speed_limit, LONGEST_MEMORY))
