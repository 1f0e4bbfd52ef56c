"""Checks of the arguments of a `Planner`, before anything is launched."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.config import PlannerConfig
from aero_planner.plan import Goal, VehicleState

FARTHEST = 1e6
"""Largest coordinate, beyond which float32 no longer resolves a decimetre [m]."""
_EXAMPLES: dict[type, str] = {
    VehicleState: "VehicleState((0, 0, 2), (0, 0, 0), (1, 0, 0, 0))", Goal: "Goal((20, 0, 2))",
}  # fmt: skip
_LARGEST = float(np.finfo(np.float64).max)


def check_configs(config: PlannerConfig | Sequence[PlannerConfig], batch: int) -> list[PlannerConfig]:
    """Return the configuration of all drones, or that of each one.

    Raises:
        ValueError: one is not a PlannerConfig, or there is not one for each drone, or they differ in structure.
    """
    configs = list(config) if isinstance(config, Sequence) else [config]
    for drone_config in configs:
        if not isinstance(drone_config, PlannerConfig):
            raise ValueError(
                f"config is {drone_config!r}; it must be a PlannerConfig, such as PlannerConfig.preset('paper')."
            )
    if isinstance(config, Sequence) and len(configs) != batch:
        raise ValueError(f"{len(configs)} configurations were given for a batch of {batch}; give one for each.")
    if any(drone_config.structure() != configs[0].structure() for drone_config in configs):
        raise ValueError(
            "the configurations of one batch differ in structure; give them equal samples, steps and grids."
        )
    return configs


def check_inputs(
    state: VehicleState, goal: Goal, cloud_age: float, ground_height: ArrayLike | None, batch: tuple[int, ...]
) -> dict[str, NDArray[np.float64]]:
    """Return the values of `PlannerInputs` by name, without the cloud's; arguments are those of `Planner.plan`.

    Args:
        batch: leading axes of the values: (B,), or () for a single drone.

    Raises:
        ValueError: an input has the wrong type or shape, is not finite, or is too large for float32.
    """
    for name, given, kind in (("state", state, VehicleState), ("goal", goal, Goal)):
        if not isinstance(given, kind):
            raise ValueError(f"{name} is {given!r}; it must be a {kind.__name__}, such as {_EXAMPLES[kind]}.")
    values = {
        "position": _check("state.position", state.position, (*batch, 3)),
        "velocity": _check("state.velocity", state.velocity, (*batch, 3)),
        "quaternion": _check("state.quaternion", state.quaternion, (*batch, 4)),
        "acceleration": _check("state.acceleration", state.acceleration, (*batch, 3), missing=np.nan),
        "disturbance": _check("state.disturbance", state.disturbance, (*batch, 3), missing=np.nan),
        "time": _check("state.time", state.time, batch, missing=np.nan, limit=_LARGEST),
        "goal_position": _check("goal.position", goal.position, (*batch, 3)),
        "goal_velocity": _check("goal.velocity", goal.velocity, (*batch, 3), missing=np.nan),
        "goal_quaternion": _check("goal.quaternion", goal.quaternion, (*batch, 4), missing=np.nan),
        "cloud_age": _check("cloud_age", cloud_age, (), limit=_LARGEST),
        "ground_height": _check_ground_height(ground_height, batch),
    }
    if values["cloud_age"] < 0.0:
        raise ValueError(f"cloud_age is {cloud_age}; it is the time since the cloud was measured [s], at least 0.")
    for name, field in (("quaternion", "state.quaternion"), ("goal_quaternion", "goal.quaternion")):
        q = values[name]
        if np.vdot(q, q) < 1e-12 if q.ndim == 1 else ((q * q).sum(axis=-1) < 1e-12).any():
            raise ValueError(f"{field} is zero; give a unit quaternion in the order w, x, y, z.")
    return values


def _check_ground_height(height: ArrayLike | None, batch: tuple[int, ...]) -> NDArray[np.float64]:
    """Return ground heights [m] of shape [] or [B], -inf where they are unknown."""
    if height is None:
        return _full(batch, -np.inf)
    if type(height) is float and -FARTHEST <= height <= FARTHEST:
        return np.full(batch, height)
    array = np.asarray(height)
    shape = batch if array.ndim else ()
    if array.dtype.kind != "f":
        return _check("ground_height", height, shape)
    unknown = array == -np.inf
    return np.where(unknown, -np.inf, _check("ground_height", np.where(unknown, 0.0, array), shape))


@functools.cache
def _full(shape: tuple[int, ...], value: float) -> NDArray[np.float64]:
    array = np.full(shape, value)
    array.flags.writeable = False
    return array


def _check(
    name: str, value: Any, shape: tuple[int, ...], *, missing: float | None = None, limit: float = FARTHEST
) -> NDArray[np.float64]:
    """Return `value` as an array of `shape`, full of `missing` if it is None and may be omitted."""
    if value is None and missing is not None:
        return _full(shape, missing)
    if not shape and type(value) is float and -limit <= value <= limit:
        return np.array(value)
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} is {value!r}; it must be numbers of shape {shape}.") from error
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}; it must have shape {shape}.")
    # False for NaN. NumPy takes four times as long for a few numbers, and a plan waits for them.
    numbers = array.ravel().tolist() if array.size <= 4 else [abs(array).max()]
    if all(-limit <= x <= limit for x in numbers):
        return array
    if not np.isfinite(array).all():
        raise ValueError(f"{name} is {array.tolist()}; every value must be finite.")
    raise ValueError(
        f"{name} is {array.tolist()}; values beyond {limit:g} have no precision left in float32: "
        "move the origin of the world nearer."
    )
