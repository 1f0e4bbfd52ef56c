"""AERO-MPPI as a planner of the workbench."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_planner import Plan, PlannerConfig
from aero_planner import Planner as Core
from aero_planner.config import DroneConfig
from aero_planner.history import History
from aero_viz.planners.observation import Observation
from aero_viz.planners.plan import Plan as AnyPlan
from aero_viz.planners.planner import Planner


class AeroMppi(Planner):
    """The planner of the package `aero_planner`, for one drone.

    Attributes:
        core: that planner, for its terms, its judgement and its arrays.
    """

    Config = PlannerConfig

    def __init__(self, config: DroneConfig | None = None, *, device: str = "cpu", seed: int = 0) -> None:
        super().__init__(config, device=device, seed=seed)
        self.core = Core(self.config, device=device, seed=seed)  # type: ignore[arg-type]
        self.device = self.core.device

    def plan(self, observation: Observation) -> Plan:
        return observation.plan_with(self.core, samples=self.samples)

    def attempt(self, observation: Observation) -> Plan:
        return self.plan(observation)  # an error would be one of this program, and is reported as such

    def configure(self, config: DroneConfig) -> None:
        self.core.configure(config)  # type: ignore[arg-type]
        self.config = config

    def history(self) -> History:
        return self.core.history()

    def restore(self, history: Any) -> None:
        self.core.restore(history) if isinstance(history, History) else self.core.reset()

    def reset(self, *, seed: int | None = None) -> None:
        super().reset(seed=seed)
        self.core.reset(seed=seed)

    def judge(self, plan: AnyPlan) -> NDArray[np.bool_]:
        return self.core.safety().is_safe

    def close(self) -> None:
        self.core.close()
