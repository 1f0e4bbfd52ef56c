"""The numbers of a tick that curves can show: of the flight, of the plan, and of planning."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from aero_planner import Plan, PlannerConfig, PlanStatus
from aero_planner.registry import load, names
from aero_viz.logs.flight_figures import CLEARANCE_MAX
from aero_viz.planners.plan import CandidatePlan, ensemble
from aero_viz.session.frame import Frame

_SOLIDS_MAX = 3000
"""Largest number of solids for which the exact clearance is computed at every tick."""


class Axis(NamedTuple):
    """An axis of values, which the signals of one lane share."""

    title: str
    """What it shows, with the unit."""
    from_zero: bool = False
    """The axis begins at zero."""
    top: float | None = None
    """Upper end; None takes the largest value."""
    is_log: bool = False
    has_outliers: bool = False
    """The axis leaves out the largest values, so that they do not flatten the others."""


class Signal(NamedTuple):
    """A number of every tick."""

    name: str
    """Name of its column, also in files."""
    label: str
    axis: Axis


SPEED = Axis("speed [m/s]", from_zero=True)
CLEARANCE = Axis("clearance [m]", from_zero=True, top=CLEARANCE_MAX)
COST = Axis("cost of the choice", is_log=True)
CANDIDATES = Axis("candidates", from_zero=True)
SAMPLES = Axis("effective samples", from_zero=True)
PLANNING = Axis("time of planning [ms]", from_zero=True, has_outliers=True)  # the first plan compiles kernels
VELOCITY = Axis("velocity [m/s]")
POSITION = Axis("position [m]")
ATTITUDE = Axis("attitude [deg]")
GOAL = Axis("distance to the goal [m]", from_zero=True)
CHOICE = Axis("number of the choice", from_zero=True)

_KNOWN = (
    Signal("speed", "speed", SPEED),
    Signal("speed_limit", "limit", SPEED),
    Signal("clearance", "true", CLEARANCE),
    Signal("plan_clearance", "of the plan", CLEARANCE),
    Signal("cost", "all", COST),
    Signal("safe", "safe", CANDIDATES),
    Signal("clear", "with clearance", CANDIDATES),
    Signal("samples", "of the choice", SAMPLES),
    Signal("plan_ms", "plan", PLANNING),
    *(Signal(f"v{axis}", axis, VELOCITY) for axis in "xyz"),
    *(Signal(axis, axis, POSITION) for axis in "xyz"),
    Signal("tilt", "tilt", ATTITUDE),
    Signal("goal_distance", "distance", GOAL),
    Signal("best", "chosen", CHOICE),
    Signal("unsafe", "no safe candidate", CANDIDATES),
)
_SIGNALS = {signal.name: signal for signal in _KNOWN}
FIRST_SHOWN = ("speed", "clearance", "plan_clearance", "cost", "samples", "plan_ms")
"""Signals that are shown at first, besides the terms of the cost."""
_MINIMAL = {field.name for field in dataclasses.fields(CandidatePlan)}
"""What every plan has."""


@functools.cache
def signal(name: str) -> Signal:
    """Return the signal of a column of `read`, or of a flight log."""
    if name in _SIGNALS:
        return _SIGNALS[name]
    if name.endswith("_cost"):
        return Signal(name, name.removesuffix("_cost"), COST)
    if name.endswith("_ms"):
        return Signal(name, name.removesuffix("_ms").replace("_", " "), PLANNING)
    controls = dict(control for model in names("models") for control in load("models", model).controls)
    if name in controls:
        return Signal(name, name, Axis(f"control [{controls[name]}]"))
    return Signal(name, name.replace("_", " "), Axis(name.replace("_", " ")))


def read(frame: Frame) -> dict[str, float]:
    """Return every number of a tick by the name of its signal; those that are unknown are left out or NaN.

    What a plan has besides the minimal one counts, too: its numbers, and of arrays with a value for each candidate the
    value of the choice.
    """
    plan, best, state = frame.plan, int(frame.plan.best), frame.observation.actual_state
    velocity = np.asarray(state.velocity, dtype=np.float64)
    position = np.asarray(state.position, dtype=np.float64)
    _, x, y, _ = np.asarray(state.quaternion, dtype=np.float64) / np.linalg.norm(state.quaternion)
    return {
        "time": frame.time,
        "speed": float(np.linalg.norm(velocity)),
        "clearance": drone_clearance(frame),
        "plan_ms": frame.timings_ms.get("plan", 0.0),
        "unsafe": float(plan.status == PlanStatus.NO_SAFE_CANDIDATE),
        "best": float(best),
        **dict(zip("xyz", position.tolist(), strict=True)),
        **dict(zip(("vx", "vy", "vz"), velocity.tolist(), strict=True)),
        "tilt": float(np.degrees(np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0)))),
        "goal_distance": float(np.linalg.norm(np.asarray(frame.observation.goal.position) - position)),
        "cost": float(plan.cost[best]),
        **{f"{name}_cost": float(cost[best]) for name, cost in plan.costs.items()},
        "plan_clearance": float(plan.clearance[best].min()),
        "safe": np.nan if frame.is_safe is None else float(np.count_nonzero(frame.is_safe)),
        **dict(_of_ensemble(frame, best)),
        **dict(_controls(frame)),
        **{f"{name}_ms": float(value) for name, value in frame.timings_ms.items() if name != "plan"},
        **{f"{name}_ms": float(value) for name, value in plan.stage_ms.items() if name != "total"},
        **dict(_own_numbers(frame, best)),
    }


def _of_ensemble(frame: Frame, best: int) -> Iterator[tuple[str, float]]:
    plan, config = ensemble(frame.plan), frame.config
    if plan is not None and isinstance(config, PlannerConfig):
        yield "clear", float(np.count_nonzero(plan.clearance.min(axis=1) >= config.candidates.safe_clearance))
        yield "samples", effective_samples(plan, best)
        yield "speed_limit", config.vehicle.speed_limit


def _controls(frame: Frame) -> Iterator[tuple[str, float]]:
    """Yield the command, with the names of the vehicle model."""
    if frame.plan.model in names("models") and len(frame.plan.command):
        controls = load("models", frame.plan.model).controls
        for (name, _), value in zip(controls, frame.plan.command[0], strict=True):
            yield name, float(value)


def _own_numbers(frame: Frame, best: int) -> Iterator[tuple[str, float]]:
    """Yield what a planner's own kind of plan adds to the minimal one."""
    count = None if ensemble(frame.plan) is not None else (len(frame.plan.kinds),)  # whose arrays are made when read
    for name, value in list(vars(frame.plan).items()):  # another thread may make an array meanwhile
        if name in _MINIMAL or not isinstance(value, (int, float, np.ndarray)):
            continue
        if np.ndim(value) == 0:
            yield name, float(value)
        elif np.shape(value) == count and np.asarray(value).dtype.kind in "biuf":
            yield name, float(np.asarray(value)[best])


def is_clearance_true(frame: Frame) -> bool:
    """Return True if `drone_clearance` is the distance to the world itself, not to the cloud."""
    world = frame.world
    return world is not None and len(world.cylinders) + len(world.boxes) + len(world.spheres) <= _SOLIDS_MAX


def drone_clearance(frame: Frame) -> float:
    """Return the distance from the drone to the nearest surface [m], at most `CLEARANCE_MAX`.

    In a world of up to 3000 solids it is exact. Otherwise it is the distance to the nearest point of the cloud.
    """
    position, world = frame.drone_position, frame.world
    if world is not None and is_clearance_true(frame):
        distance = float(world.distance(position[None])[0])
    else:
        plan = ensemble(frame.plan)
        points = frame.observation.points if plan is None else plan.filtered_points
        distance = float(np.linalg.norm(points - position, axis=1).min(initial=np.inf))
    return float(np.clip(distance, 0.0, CLEARANCE_MAX))


def effective_samples(plan: Plan, instance: int, temperature: float | None = None) -> float:
    """Return the effective number of samples of an instance in Stage I, 1 / sum(w^2) with w the weights.

    Args:
        plan: with the costs of the samples.
        instance: its index.
        temperature: of the weights; None is that of the plan. NaN where neither is known.
    """
    if temperature is None:
        temperature = math.nan if plan.temperature is None else float(plan.temperature[instance])
    cost = np.asarray(plan.stage1_cost[instance], dtype=np.float64)
    weights = np.exp(-(cost - cost.min()) / temperature)
    return float(weights.sum() ** 2 / (weights**2).sum())
