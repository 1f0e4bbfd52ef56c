"""A sequence of plans that uses every stage, and what a planner records, to compare one with another."""

import hashlib
from typing import Any

import numpy as np
import warp as wp

from aero_planner import Goal, Plan, Planner, PlannerConfig, Sweeps, VehicleState
from aero_planner.array_memory import allocate, as_dict
from aero_planner.arrays import CloudArrays, PlannerInputs, PlannerOutputs, Sizes, SweepTable, Workspace
from aero_planner.composition import Composition
from aero_planner.device.kernel_tuning import KernelTuning
from aero_planner.device.params import Params
from aero_planner.kernels.shells import COUNTERS
from aero_planner.pipeline import Pipeline
from aero_planner.recorder import PlannerArrays
from aero_planner.warp_init import find_device
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


def recorded(config: PlannerConfig, tuning: KernelTuning, *, batch: int = 1) -> tuple[list[wp.Kernel], dict[str, Any]]:
    """Return the kernel of each launch of a planner, and the shapes of its arrays. Nothing is compiled or launched."""
    composition = Composition.of(config)
    sizes = Sizes.from_config(config, composition, batch=batch, workers=1, tuning=tuning)
    device = find_device("cpu")

    def made(kind: type | None) -> Any:
        return None if kind is None else allocate(kind, sizes, device)

    of_stages = {stage.name: (made(stage.arrays), made(stage.outputs)) for stage in composition.stages}

    class SweepSizes:
        B, S, P, E = batch, 3, 100, int(COUNTERS)

    change, params = allocate(SweepTable, SweepSizes, device).change, wp.zeros(batch, dtype=Params, device=device)
    arrays = PlannerArrays(
        made(PlannerInputs), made(PlannerOutputs), made(Workspace), of_stages,
        allocate(CloudArrays, SweepSizes, device), change, params,
    )  # fmt: skip
    kernels = [kernel for kernel, _ in Pipeline(config, composition, sizes, tuning, arrays, dry=True).kernels]
    shapes = {name: array.shape for group in arrays.groups() for name, array in as_dict(group).items()}
    return kernels, shapes


def description(names: tuple[str, ...], tuning: KernelTuning) -> str:
    """Return a hash of what a planner with these stages launches and allocates: kernels with their code, and shapes."""
    kernels, shapes = recorded(config_with(names), tuning)
    launches = [(kernel.func.__module__, kernel.key, kernel.adj.source) for kernel in kernels]
    return hashlib.sha256(repr((launches, shapes)).encode()).hexdigest()
