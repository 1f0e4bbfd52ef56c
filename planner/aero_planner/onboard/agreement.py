"""Whether the configurations of planner and node fit each other."""

from __future__ import annotations

from aero_planner.config import PlannerConfig
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.tuning_limits import check_limits
from aero_planner.parameters import ContradictionError


def check_together(planner: PlannerConfig, onboard: OnboardConfig) -> None:
    """Raise `ContradictionError`, a ValueError, if the configurations of planner and node contradict each other."""
    vehicle = planner.vehicle
    if vehicle.model != "ctbr":
        raise ContradictionError(
            f"vehicle.model is {vehicle.model}; the node commands thrust and body rates, so it must be ctbr.",
            "vehicle.model",
        )
    if onboard.limits.plan_age >= planner.horizon:
        raise ContradictionError(
            f"limits.plan_age is {onboard.limits.plan_age}; it must be less than the planner's horizon, "
            f"sampling.steps x sampling.dt = {planner.horizon:g} s.",
            "limits.plan_age", "sampling.steps", "sampling.dt",
        )  # fmt: skip
    if vehicle.thrust_max <= vehicle.mass * vehicle.gravity:
        raise ContradictionError(
            f"vehicle.thrust_max is {vehicle.thrust_max} N; it must exceed the weight of "
            f"{vehicle.mass * vehicle.gravity:.2f} N, vehicle.mass x vehicle.gravity, or the drone can't fly.",
            "vehicle.thrust_max", "vehicle.mass", "vehicle.gravity",
        )  # fmt: skip
    check_limits(planner, onboard.tuning.limits)
