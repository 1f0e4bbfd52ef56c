"""The problem that all libraries solve, in NumPy: start, goal, filtered cloud, guides and nominal controls."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_planner import Planner, PlannerConfig
from aero_planner.forest_cloud import forest_flight

Array = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Problem:
    """M instances of K samples over N steps; all lengths in metres, world frame, quaternions w x y z."""

    config: PlannerConfig
    state: Array
    """State p, q, v, SI units, shape [10]."""
    goal: Array
    """State p, q, v, SI units, shape [10]."""
    cloud: Array
    """Filtered cloud, shape [F, 3]."""
    guides: Array
    """Guides [m], shape [M, N + 1, 3]."""
    nominal: Array
    """Nominal controls [N, rad/s], shape [M, N, 4]."""
    nominal_cost: Array
    """S1 of the nominal controls, shape [M], which every library must reproduce."""

    @property
    def variance(self) -> list[float]:
        """Variances of the noise of the four controls."""
        s = self.config.sampling
        return [s.variance_thrust, s.variance_rate_xy, s.variance_rate_xy, s.variance_rate_z]

    @property
    def limits(self) -> tuple[list[float], list[float]]:
        """Lower and upper limits of the controls."""
        v = self.config.vehicle
        high = [v.rate_xy_max, v.rate_xy_max, v.rate_z_max]
        return [v.thrust_min, *(-rate for rate in high)], [v.thrust_max, *high]


def problem_config(instances: tuple[int, int], samples: int) -> PlannerConfig:
    """Return the paper's costs with white noise, which all libraries support, for M_h x M_v instances of K samples."""
    columns, rows = instances
    return PlannerConfig.preset("paper").replace(
        {"anchors.columns": columns, "anchors.rows": rows, "sampling.samples": samples}
    )


def make_problem(config: PlannerConfig, points: int, device: str = "cpu") -> Problem:
    """Return the problem whose filtered cloud and guides come from the planner on a device."""
    quiet: dict[str, Any] = {"sampling.samples": 1, "candidates.safe_clearance": 0.0}
    quiet |= {f"sampling.variance_{name}": 0.0 for name in ("thrust", "rate_xy", "rate_z")}
    state, goal, cloud = forest_flight(points)
    planner = Planner(config.replace(quiet), device=device)
    plan = planner.plan(state, goal, cloud)
    planner.close()
    assert isinstance(plan.filtered_points, np.ndarray)
    level = [1.0, 0.0, 0.0, 0.0]  # the goal lies straight ahead
    return Problem(
        config=config,
        state=np.concatenate([np.asarray(x) for x in (state.position, state.quaternion, state.velocity)]).astype("f4"),
        goal=np.concatenate((np.asarray(goal.position), level, np.zeros(3))).astype("f4"),
        cloud=plan.filtered_points,
        guides=plan.guides,
        nominal=plan.controls,
        nominal_cost=plan.stage1_cost[:, 0],
    )
