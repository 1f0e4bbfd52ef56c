"""The parameters of the paper by their symbols, as one struct that every kernel takes."""

from __future__ import annotations

from typing import Any

import warp as wp

from aero_planner.config import PlannerConfig
from aero_planner.registry import names

PATHS = {
    "m": "vehicle.mass",
    "g": "vehicle.gravity",
    "F_min": "vehicle.thrust_min",
    "F_max": "vehicle.thrust_max",
    "omega_xy_max": "vehicle.rate_xy_max",
    "omega_z_max": "vehicle.rate_z_max",
    "r_max": "partition.range_max",
    "spacing": "anchors.spacing",
    "l": "anchors.lookahead",
    "dt": "sampling.dt",
    "lambda_": "sampling.temperature",
    "Sigma_F": "sampling.variance_thrust",
    "Sigma_xy": "sampling.variance_rate_xy",
    "Sigma_z": "sampling.variance_rate_z",
    "Q_p": "costs.q_position",
    "Q_v": "costs.q_velocity",
    "Q_q": "costs.q_attitude",
    "Q_track": "costs.q_track",
    "Q_vnorm": "costs.q_vnorm",
    "Q_c": "costs.q_control",
    "Q_cd": "costs.q_control_rate",
    "C": "costs.penalty",
    "a": "costs.decay",
    "d_min": "costs.distance_min",
    "d_max": "costs.distance_max",
}
"""Parameter of the configuration by its symbol."""

SIZES = ("anchors.columns", "anchors.rows", "partition.fine_cells", "sampling.samples", "sampling.steps")
"""M_h, M_v, fine cells along a coarse cell, K and N."""

Parameters: Any = wp.struct(
    type("Parameters", (), {"__annotations__": dict.fromkeys(PATHS, wp.float32), "__module__": __name__})
)


def parameters_of(config: PlannerConfig) -> Any:
    """Return the parameters of the paper.

    Raises:
        ValueError: the configuration uses an option that the paper does not have.
    """
    paper, known = PlannerConfig.preset("paper"), {*PATHS.values(), *SIZES}
    options = [info.path for info in config.parameters() if config.get(info.path) != paper.get(info.path)]
    # What stages that are not active would do does not matter; an active one differs in stages.active.
    foreign = [path for path in options if path not in known and path.split(".")[0] not in names("stages")]
    if foreign:
        raise ValueError(
            f"the paper has no {', '.join(foreign)}: the reference takes the preset 'paper' with other values of "
            f"{', '.join(sorted(known))}."
        )
    c = Parameters()
    for symbol, path in PATHS.items():
        setattr(c, symbol, config.get(path))
    return c
