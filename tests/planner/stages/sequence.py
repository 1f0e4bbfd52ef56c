"""A sequence of plans that uses every stage, and what two planners must agree in."""

import hashlib

import numpy as np

from aero_planner import Goal, Plan, Planner, PlannerConfig, Sweeps, VehicleState
from tests.planner.cases import PLAN_ARRAYS
from tests.planner.pillars import sweeps_of


def sequence(planner: Planner, *, ticks: int = 7) -> list[Plan]:
    """Return the plans of a drone that flies between a wall and a pillar that moves, and then gets stuck.

    A sweep arrives in every other tick, an old one is thinned, the drone's acceleration is measured, and the last cloud
    is too old.
    """
    rng = np.random.default_rng(0)
    y, z = np.meshgrid(np.arange(-3.0, 1.0, 0.08), np.arange(-0.5, 2.0, 0.08))
    wall = np.column_stack((np.full(y.size, 3.5), y.ravel(), z.ravel()))
    moving, _ = sweeps_of([(np.array([3.0, 1.8]), np.array([0.0, -1.0]))], np.zeros(3), count=10)
    sweeps, plans = Sweeps(whole=9), []
    for points, arrival in zip(moving, moving.arrivals, strict=True):
        sweeps = sweeps.add(np.concatenate((points, wall)).astype(np.float32), limit=30, arrival=arrival)
    newest = sweeps.arrivals[-1]
    assert newest is not None
    for tick in range(ticks):
        speed = 4.0 - 0.5 * tick
        position, velocity = np.array([0.04 * tick, 0.0, 0.0]), np.array([speed, 0.3, 0.1])
        half = 0.02 * tick
        attitude = np.array([np.cos(half), 0.0, np.sin(half), 0.0])
        state = VehicleState(
            position, velocity, attitude, rng.normal(size=3), time=newest.time + 0.06 * tick,
        )  # fmt: skip
        plans.append(planner.plan(state, Goal((20.0, 0.0, 0.5)), sweeps, cloud_age=9.0 if tick == ticks - 1 else 0.0))
        if tick % 2:
            last = np.concatenate((list(moving)[-1], wall)).astype(np.float32)
            sweeps = sweeps.add(last, limit=30)
    return plans


def digest(plans: list[Plan]) -> str:
    """Return a hash of everything that the core reports of plans, bit for bit."""
    total = hashlib.sha256()
    for plan in plans:
        for name in PLAN_ARRAYS:
            if name != "continued_cells":  # a stage's own report
                total.update(np.ascontiguousarray(getattr(plan, name)).tobytes())
        total.update(repr((plan.kinds, plan.best, plan.status, plan.dropped_points, plan.drag)).encode())
    return total.hexdigest()


def config_with(names: tuple[str, ...]) -> PlannerConfig:
    """Return a small configuration with these stages."""
    small = {"sampling.samples": 16, "sampling.steps": 15, "anchors.columns": 3, "partition.fine_cells": 4}
    return PlannerConfig().replace(small | {"stages.active": ", ".join(names)})
