"""The plan of the values that the device has computed."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_planner.arrays import fine_shape
from aero_planner.config import PlannerConfig
from aero_planner.kernels.guides import BRAKING_FAN
from aero_planner.plan import BrakingCandidates, Plan, PlanStatus

__all__ = ["make_plan"]


def make_plan(
    values: NDArray[Any],
    config: PlannerConfig,
    *,
    batched: bool,
    stage_ms: dict[str, float],
    samples: NDArray[np.float32] | None,
) -> Plan:
    """Return the plan of the values of `PlannerOutputs`; `Plan` describes the other arguments.

    Args:
        values: record of the arrays by name, which the plan keeps.
        config: configuration of the planner.
        batched: True to keep the leading axis of drones.
        stage_ms: time of each stage [ms].
        samples: positions of the Stage I rollouts [m], shape [B, M, K, N + 1, 3], or None.
    """
    B, M, part = len(values["best"]), len(config.kinds), config.partition
    coarse = (B, part.coarse_rows, part.coarse_columns)
    filtered = [
        cloud.take(np.flatnonzero(occupied), axis=0)
        for cloud, occupied in zip(values["filtered_points"], values["occupied"] != 0, strict=True)
    ]
    kinds = list(config.kinds)
    if not batched and values["braking_instance"][0] >= 0:
        kinds[values["braking_instance"][0]] = "brake"

    def per_drone(array: NDArray[Any]) -> Any:
        return array if batched else array[0]

    def instances(name: str) -> Any:
        return per_drone(values[name][:, :M])

    def braking(name: str) -> Any:
        return per_drone(values[name][:, M : M + int(BRAKING_FAN)])

    return Plan(
        fine_range=per_drone(values["fine_range"].reshape(B, *fine_shape(config))),
        safe_range=per_drone(values["safe_range"].reshape(coarse)),
        safe_direction=per_drone(values["safe_direction"].reshape(*coarse, 3)),
        filtered_points=filtered if batched else filtered[0],
        initial_endpoints=instances("initial_endpoints"),
        anchors=instances("anchors"),
        guide_coefficients=np.swapaxes(instances("guide_coefficients"), -1, -2),
        guides=instances("guides"),
        kinds=tuple(kinds),
        controls=instances("controls"),
        positions=instances("positions"),
        velocities=instances("velocities"),
        quaternions=instances("quaternions"),
        stage1_cost=per_drone(values["stage1_cost"].reshape(B, M, -1))[..., : config.sampling.samples],
        stage2_cost=instances("stage2_cost"),
        goal_cost=instances("goal_cost"),
        collision_cost=instances("collision_cost"),
        clearance=instances("clearance"),
        best=values["best"] if batched else int(values["best"][0]),
        status=values["status"] if batched else PlanStatus(int(values["status"][0])),
        dropped_points=values["dropped_points"] if batched else int(values["dropped_points"][0]),
        stage_ms=stage_ms,
        braking=BrakingCandidates(braking("positions"), braking("velocities"), braking("clearance").min(axis=-1)),
        samples=None if samples is None else per_drone(samples),
    )
