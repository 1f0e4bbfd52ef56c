"""A minimal planner of the tests: it flies straight toward the goal, or would hover. No obstacle stops it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from aero_planner.config import DroneConfig, ParameterSection
from aero_planner.parameters import live
from aero_viz.planners import CandidatePlan, Observation, Planner

STEP, STEPS = 0.1, 10


@dataclass(frozen=True)
class Line(ParameterSection, section="line"):
    """Line: how it is followed."""

    gain: float = live(2.0, "1/s", 0.1, 10.0, "Acceleration per missing velocity.", basic=True)


@dataclass(frozen=True)
class StraightConfig(DroneConfig):
    """The drone and the line."""

    line: Line = field(default_factory=Line)

    @classmethod
    def preset_changes(cls) -> dict[str, tuple[str, dict[str, Any]]]:
        return {"default": ("As it is.", {}), "soft": ("A small gain.", {"line.gain": 0.5})}


class Straight(Planner):
    """Flies straight toward the goal; counts its plans, which is its history."""

    Config = StraightConfig

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.count = 0

    def history(self) -> int:
        return self.count

    def restore(self, history: Any) -> None:
        self.count = history if isinstance(history, int) else 0

    def plan(self, observation: Observation) -> CandidatePlan:
        self.count += 1
        position, velocity = np.asarray(observation.state.position), np.asarray(observation.state.velocity)
        to_goal = np.asarray(observation.goal.position) - position
        distance = float(np.linalg.norm(to_goal))
        wanted = min(self.config.vehicle.speed_limit, distance) * to_goal / max(distance, 1e-9)
        times = STEP * np.arange(STEPS + 1)[:, None]
        paths = np.stack((position + times * wanted, np.tile(position, (STEPS + 1, 1))))
        costs = {"goal": np.linalg.norm(paths[:, -1] - np.asarray(observation.goal.position), axis=1)}
        costs["count"] = np.array([0.0, 1e-3 * self.count])
        controls = np.tile([*(self.config.line.gain * (wanted - velocity)), 0.0], (STEPS, 1))
        is_safe = np.array([True, False])
        return CandidatePlan(paths, costs, 0, STEP, controls=controls, kinds=("line", "hover"), is_safe=is_safe)
