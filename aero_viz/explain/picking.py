"""Meaning of a click in the scene: an instance, a point of the cloud or a cell; and where a point came from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner import PlannerConfig
from aero_planner.quaternions import rotation_matrix
from aero_viz.explain.verdict import obstacle_name
from aero_viz.planners.plan import ensemble
from aero_viz.session.frame import Frame

Array = NDArray[np.float64]

_INSTANCE_ANGLE, _POINT_ANGLE = 0.02, 0.01
"""Largest angles between the click and its target [rad]."""
_LEFT_OUT = 0.02
"""Smallest difference in range by which a point counts as nearer than the nearest one of its cell [m]."""
_FINER = 4
"""Pieces into which the steps of a rollout are divided."""


@dataclass(frozen=True, eq=False)
class Picked:
    """Meaning of a click."""

    kind: str
    """"anchor", "rollout", "guide", "point" or "cell"."""
    instance: int | None = None
    point: Array | None = None
    """Point of the cloud [m], shape [3]; for a cell, the nearest one in it."""


def pick(frame: Frame, origin: ArrayLike, direction: ArrayLike, *, cells: bool = False) -> Picked | None:
    """Return the target on a ray from the eye; None if there is none.

    Anchors, rollouts and guides come before points, and these before cells.

    Args:
        frame: frame that is shown.
        origin: eye [m], shape [3].
        direction: unit vector, shape [3].
        cells: True if cells are shown, at their ranges.
    """
    eye, ray, plan = np.asarray(origin, dtype=np.float64), np.asarray(direction, dtype=np.float64), frame.plan
    found: list[tuple[float, Picked]] = []
    full = ensemble(plan)
    lines = {"rollout": plan.positions}
    if full is not None:
        lines = {"anchor": full.anchors[:, None], **lines, "guide": full.guides}
    for kind, places in lines.items():
        share = np.linspace(0.0, 1.0, _FINER, endpoint=False)[:, None]
        pieces = places[:, :-1, None] * (1.0 - share) + places[:, 1:, None] * share if places.shape[1] > 1 else places
        angles = _angles(pieces.reshape(len(places), -1, 3).astype(np.float64), eye, ray).min(axis=1)
        instance = int(angles.argmin())
        found.append((float(angles[instance]), Picked(kind, instance)))
    angle, nearest = min(found, key=lambda entry: entry[0])
    if angle < _INSTANCE_ANGLE:
        return nearest
    cloud = np.asarray(frame.observation.points, dtype=np.float64)
    for kind, points, reach in (("point", cloud, _POINT_ANGLE), ("cell", _cell_points(frame), 0.05)):
        if kind == "cell" and not cells:
            break
        on_ray = np.flatnonzero(_angles(points, eye, ray) < reach)
        if len(on_ray):
            return Picked(kind, point=points[on_ray[((points[on_ray] - eye) @ ray).argmin()]])
    return None


def _angles(points: Array, eye: Array, ray: Array) -> Array:
    """Return the angle of each point, [.., 3], to a ray [rad]; infinite behind the eye."""
    offset = points - eye
    along = offset @ ray
    across = np.linalg.norm(offset - along[..., None] * ray, axis=-1)
    return np.where(along > 0.05, across / np.maximum(along, 1e-9), np.inf)


def _cell_points(frame: Frame) -> Array:
    plan = ensemble(frame.plan)
    return np.asarray(frame.observation.points if plan is None else plan.filtered_points, dtype=np.float64)


def describe_point(frame: Frame, point: Array) -> list[tuple[str, str]]:
    """Return labels and values on a point of the cloud: range, age, sweep, obstacle, and its cells."""
    seen, plan, config = frame.observation, ensemble(frame.plan), frame.config
    state = seen.state
    offset = point - np.asarray(state.position, dtype=np.float64)
    distance = float(np.linalg.norm(offset))
    x, y, z = offset @ rotation_matrix(state.quaternion)
    facts = [
        ("range", f"{distance:.2f} m"),
        ("position", ", ".join(f"{value:.2f}" for value in point) + " m"),
        ("obstacle", obstacle_name(frame.world, point)),
    ]
    sweeps = list(seen.sweeps)
    gaps = [float(np.linalg.norm(sweep - point, axis=1).min(initial=np.inf)) for sweep in sweeps]
    number = int(np.argmin(gaps)) if gaps else 0
    if not gaps or gaps[number] > 1e-4:
        facts.append(("measured", "never: the continuation of a surface past the field of view"))
    else:
        facts.append(("sweep", f"{number + 1} of {len(sweeps)}, counted from the oldest"))
        if seen.sweep_times is not None and len(seen.sweep_times) == len(sweeps):
            facts.append(("age", f"{seen.time - seen.sweep_times[number]:.2f} s since the end of that sweep"))
        else:
            facts.append(("age", "unknown: the source has no times of sweeps"))
    if plan is None or not isinstance(config, PlannerConfig):
        return [*facts, ("cells", "this planner has none")]
    shape = np.array(plan.fine_range.shape)
    turns = np.array((np.arctan2(z, np.hypot(x, y)) / np.pi + 0.5, np.arctan2(y, x) / (2.0 * np.pi) + 0.5))
    row, column = np.minimum((turns * shape).astype(int), shape - 1)
    into_cell = turns * shape - (row, column)
    pool = config.partition.fine_cells
    if gaps and gaps[number] <= 1e-4:
        # At the border of a cell, rounding decides which one holds the point. The plan may start a little later.
        is_inside = bool(np.abs(into_cell - 0.5).max() < 0.45)
        moved = config.vehicle.delay * float(np.linalg.norm(state.velocity))
        is_left_out = is_inside and distance < plan.fine_range[row, column] - _LEFT_OUT - moved
        if is_left_out and distance < config.partition.range_min:
            facts.append(("partition", "left out: nearer than partition.range_min"))
    return [
        *facts,
        ("fine cell", f"row {row}, column {column}: nearest {plan.fine_range[row, column]:.2f} m"),
        ("coarse cell", f"largest range {plan.safe_range[row // pool, column // pool]:.2f} m"),
    ]
