"""Makes a `Plan` of the values that the device has computed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_planner.arrays import Sizes, Workspace
from aero_planner.config import PlannerConfig
from aero_planner.config.planner_config import COARSE_COLUMNS, COARSE_ROWS
from aero_planner.kernels.guides import BRAKING_FAN
from aero_planner.plan import BatchPlan, BrakingCandidates, Plan, PlanArrays, PlanStatus
from aero_planner.stage import Stage

_PER_INSTANCE = frozenset({
    "initial_endpoints", "anchors", "guide_coefficients", "guides", "controls", "positions", "velocities",
    "quaternions", "stage2_cost", "goal_cost", "collision_cost", "clearance",
})  # fmt: skip
"""Arrays with rows of the M instances and the braking candidates, of which a plan shows the instances."""
_OF_GUIDES = frozenset({"anchors", "guide_coefficients", "guides"})
"""Arrays in which a plan shows those of what is flown in the place of the instance that it has replaced."""
_ARRAYS = _PER_INSTANCE | {
    "fine_range", "safe_range", "safe_direction", "filtered_points", "stage1_cost", "temperature",
}  # fmt: skip


def make_plan(
    values: NDArray[Any],
    config: PlannerConfig,
    stages: Sequence[Stage],
    *,
    batched: bool,
    stage_ms: dict[str, float],
    samples: NDArray[np.float32] | None,
) -> PlanArrays:
    """Return the plan of the values of `PlannerOutputs`; `Plan` describes the other arguments.

    Args:
        values: record of the arrays by name, which the plan keeps.
        config: configuration of the planner.
        stages: active stages, each of which makes its part of the plan.
        batched: True to keep the leading axis of drones.
        stage_ms: time of each stage [ms].
        samples: positions of the Stage I rollouts [m], shape [B, M, K, N + 1, 3], or None.
    """
    arrays = _PlanArrays(values, config, stages, batched)
    best, status, dropped_points = values["best"], values["status"], values["dropped_points"]
    return (BatchPlan if batched else Plan).with_lazy_arrays(
        arrays,
        best=best if batched else int(best[0]),
        status=status if batched else PlanStatus(int(status[0])),
        dropped_points=dropped_points if batched else int(dropped_points[0]),
        disturbance=arrays.per_drone(values["disturbance"]),
        drag=values["drag"] if batched else float(values["drag"][0]),
        stage_ms=stage_ms,
        samples=None if samples is None else arrays.per_drone(samples),
        model=config.vehicle.model,
    )


def sampled_positions(work: Workspace, sizes: Sizes, positions: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the positions of the Stage I rollouts [m], shape [B, M, K, N + 1, 3], world frame.

    Args:
        work: workspace of the planner, which holds the positions after the start.
        sizes: sizes of its arrays.
        positions: positions of the Stage II rollouts [m], shape [B, R, N + 1, 3], whose first is that of Stage I, too.
    """
    B, M, N, K = sizes.B, sizes.M, sizes.N, sizes.K
    array: Any = work.sample_positions.numpy()  # its declared type lacks dtype and shape
    states = array[:, :N, :, :K].transpose(0, 3, 1, 2).reshape(B, M, K, N, 3)
    start = np.broadcast_to(positions[:, :M, None, :1], (B, M, K, 1, 3))
    return np.concatenate((start, states), axis=3)


class _PlanArrays:
    """Makes the arrays of a plan, each when it is first read: most readers need few of them."""

    def __init__(self, values: NDArray[Any], config: PlannerConfig, stages: Sequence[Stage], batched: bool) -> None:
        self._values, self._config, self._batched = values, config, batched
        self._reports = {name: report for stage in stages for name, report in stage.reports.items()}
        self._drones, self._instances = len(values["best"]), len(config.kinds)

    def per_drone(self, array: Any) -> Any:
        return array if self._batched else array[0]

    def _braking(self) -> BrakingCandidates:
        rows = slice(self._instances, self._instances + int(BRAKING_FAN))
        positions, velocities, clearance = (
            self.per_drone(self._values[name][:, rows]) for name in ("positions", "velocities", "clearance")
        )
        return BrakingCandidates(positions, velocities, clearance.min(axis=-1))

    def __call__(self, name: str) -> Any:
        """Return a field of `Plan`; raises AttributeError for another name."""
        makers = {"kinds": self._kinds, "braking": self._braking}
        if name in makers:
            return makers[name]()
        if name in self._reports:
            return self._reports[name](self._values, self._config, self._batched)
        if name not in _ARRAYS:
            if name in Plan.__dataclass_fields__:
                return None  # that of a stage which is not active
            raise AttributeError(f"a plan has no attribute {name!r}")
        array, B = self._values[name], self._drones
        if name in _PER_INSTANCE:
            array = self._with_replacement(array) if name in _OF_GUIDES else array[:, : self._instances]
        match name:
            case "fine_range":
                array = array.reshape(B, *self._config.fine_shape)
            case "safe_range" | "safe_direction":
                array = array.reshape(B, COARSE_ROWS, COARSE_COLUMNS, *array.shape[2:])
            case "guide_coefficients":
                array = np.swapaxes(array, -1, -2)
            case "stage1_cost":
                array = array.reshape(B, self._instances, -1)[..., : self._config.sampling.samples]
            case "filtered_points":
                clouds = zip(array, self._values["occupied"] != 0, strict=True)
                array = [cloud.take(np.flatnonzero(occupied), axis=0) for cloud, occupied in clouds]
        return self.per_drone(array)

    def _with_replacement(self, array: NDArray[Any]) -> NDArray[Any]:
        shown = array[:, : self._instances]
        drones = np.flatnonzero(self._values["braking_instance"] >= 0)
        if drones.size:
            shown = shown.copy()
            shown[drones, self._values["best"][drones]] = array[drones, self._values["flown"][drones]]
        return shown

    def _kinds(self) -> tuple[str, ...]:
        kinds = list(self._config.kinds)
        replaced = self._values["braking_instance"][0]
        if not self._batched and replaced >= 0:
            kinds[replaced] = "brake"
        return tuple(kinds)
