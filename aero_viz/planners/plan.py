"""What every planner returns: candidate paths, their costs by term, and the choice."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner import Plan as EnsemblePlan
from aero_planner import PlanStatus

Array = NDArray[Any]
EXTENSIONS = ("cells", "anchors", "guides", "samples", "tracks")
"""What a plan may have besides a minimal one, as plans of AERO-MPPI do; see `aero_planner.Plan`."""


class Plan(Protocol):
    """A plan of M candidates with N time steps, as the workbench reads it.

    `CandidatePlan` and the plan of AERO-MPPI have all of this. Arrays never change.
    """

    extensions: ClassVar[tuple[str, ...]]
    """What else the plan has, of `EXTENSIONS`."""

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kind of each candidate, length M."""
        ...

    @property
    def positions(self) -> Array:
        """Candidate paths, the start included [m], shape [M, N+1, 3], world frame."""
        ...

    @property
    def velocities(self) -> Array:
        """[m/s], shape [M, N+1, 3], world frame."""
        ...

    @property
    def quaternions(self) -> Array:
        """Attitudes, body to world, w x y z, shape [M, N+1, 4]."""
        ...

    @property
    def cost(self) -> Array:
        """Whole cost of each candidate, shape [M]."""
        ...

    @property
    def costs(self) -> Mapping[str, Array]:
        """Terms of the cost that are shown, by label, each of shape [M]; the most important one is the first."""
        ...

    @property
    def clearance(self) -> Array:
        """Distance to the obstacles after each step [m], shape [M, N]; NaN where it is unknown."""
        ...

    @property
    def best(self) -> Any:
        """Number of the candidate that is flown."""
        ...

    @property
    def status(self) -> Any:
        """Its safety, a `PlanStatus`."""
        ...

    @property
    def command(self) -> Array:
        """Controls to fly, as the vehicle model takes them, shape [N, 4]."""
        ...

    @property
    def model(self) -> str:
        """Vehicle model, which says what the controls are."""
        ...

    @property
    def stage_ms(self) -> Mapping[str, float]:
        """Time of each stage of planning, and "total" [ms]; a session measures the total of a plan that has none."""
        ...


@dataclass(frozen=True, eq=False)
class CandidatePlan:
    """A minimal plan: M candidate paths with N steps, their costs by term, and the choice.

    Args:
        positions: paths, the start included [m], shape [M, N+1, 3], world frame.
        costs: terms of the cost by label, each of shape [M].
        best: number of the candidate to fly.
        step: time step of the paths and of the controls [s].
        status: safety of the choice.
        controls: what to fly, shape [n, 4], for `model`; None is the acceleration along the chosen path, without a
            change of the yaw.
        model: vehicle model of the controls: "acceleration" for acceleration [m/s^2] and yaw rate [rad/s], "ctbr" for
            thrust [N] and body rates [rad/s].
        clearance: distance to the obstacles after each step [m], shape [M, N]; None where it is unknown.
        is_safe: True for each candidate that may be flown, shape [M]; None where it is unknown.
        kinds: kind of each candidate; None calls all of them "path".
        stage_ms: time of each stage of planning [ms].

    Raises:
        ValueError: the shapes do not fit each other, or a number is not finite; says which.
    """

    extensions: ClassVar[tuple[str, ...]] = ()

    positions: Array
    costs: Mapping[str, Array]
    best: int
    step: float
    status: PlanStatus = PlanStatus.OK
    controls: Array | None = None
    model: str = "acceleration"
    clearance: Any = None
    is_safe: NDArray[np.bool_] | None = None
    kinds: Any = None
    stage_ms: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        positions = _checked("positions", self.positions, (-1, -1, 3))
        M, N = positions.shape[0], positions.shape[1] - 1
        if N < 1 or M < 1:
            raise ValueError(f"positions have the shape {positions.shape}; give a path of at least one step.")
        if not 0 <= int(self.best) < M:
            raise ValueError(f"best is {self.best}; it must be in [0, {M - 1}].")
        if not (np.isfinite(self.step) and self.step > 0.0):
            raise ValueError(f"step is {self.step}; it must be a positive time [s].")
        controls = self._along(positions[int(self.best)]) if self.controls is None else self.controls
        if len(controls) < 1:
            raise ValueError("controls are empty; give one at least, or None.")
        clearance = np.full((M, N), np.nan) if self.clearance is None else self.clearance
        own = {
            "positions": positions,
            "costs": {name: _checked(f"costs[{name!r}]", cost, (M,)) for name, cost in self.costs.items()},
            "best": int(self.best),
            "status": PlanStatus(int(self.status)),
            "controls": _checked("controls", controls, (-1, 4)),
            "clearance": _checked("clearance", clearance, (M, N), finite=False),
            "is_safe": None if self.is_safe is None else np.array(self.is_safe, dtype=bool),
            "kinds": ("path",) * M if self.kinds is None else tuple(map(str, self.kinds)),
        }
        if len(own["kinds"]) != M or (self.is_safe is not None and np.shape(self.is_safe) != (M,)):
            raise ValueError(f"kinds and is_safe must have one entry for each of the {M} candidates.")
        for name, value in own.items():
            object.__setattr__(self, name, value)

    def _along(self, path: Array) -> NDArray[np.float64]:
        """Return the accelerations along a path, and no yaw rate, shape [N, 4]."""
        velocity = np.diff(path.astype(np.float64), axis=0) / self.step
        acceleration = np.diff(velocity, axis=0, append=velocity[-1:]) / self.step
        return np.pad(acceleration, ((0, 0), (0, 1)))

    @property
    def cost(self) -> Array:
        return np.sum(list(self.costs.values()), axis=0) if self.costs else np.zeros(len(self.positions), np.float32)

    @property
    def command(self) -> Array:
        assert self.controls is not None
        return self.controls

    @property
    def velocities(self) -> Array:
        return np.gradient(self.positions, self.step, axis=1)

    @property
    def quaternions(self) -> Array:
        """Level attitudes with the nose along the paths."""
        v = self.velocities
        half = 0.5 * np.arctan2(v[..., 1], v[..., 0])
        return np.stack((np.cos(half), 0.0 * half, 0.0 * half, np.sin(half)), axis=-1).astype(np.float32)


def ensemble(plan: Plan | None) -> EnsemblePlan | None:
    """Return a plan with all that AERO-MPPI adds: cells, anchors, guides and samples; None if it has no such things."""
    return plan if isinstance(plan, EnsemblePlan) else None


def lacks(plan: Plan, *extensions: str) -> str:
    """Return in one line which of some `EXTENSIONS` a plan lacks; empty if it has all of them."""
    missing = [name for name in extensions if name not in plan.extensions]
    return f"This planner has no {', '.join(missing)}." if missing else ""


def cell_angles(shape: tuple[int, ...]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return azimuth and elevation of the centre of every cell [rad], row by row, each of shape [rows * columns].

    Args:
        shape: rows and columns of the cells, such as those of `aero_planner.Plan.fine_range`.
    """
    rows, columns = shape
    elevation = np.radians(-90.0 + 180.0 * (np.arange(rows) + 0.5) / rows)
    azimuth = np.radians(-180.0 + 360.0 * (np.arange(columns) + 0.5) / columns)
    return np.tile(azimuth, rows), np.repeat(elevation, columns)


def directions_at(azimuth: NDArray[np.float64], elevation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit vectors [.., 3] from angles [rad], [..]."""
    flat = np.cos(elevation)
    return np.stack((flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)), axis=-1)


def _checked(name: str, values: ArrayLike, shape: tuple[int, ...], *, finite: bool = True) -> Array:
    """Return values as float32 if they have the shape, with -1 for any size."""
    array = np.array(values, dtype=np.float32)
    if array.ndim != len(shape) or any(size not in (-1, given) for size, given in zip(shape, array.shape, strict=True)):
        wanted = ", ".join("any" if size == -1 else str(size) for size in shape)
        raise ValueError(f"{name} has the shape {array.shape}; it must be ({wanted}).")
    if finite and not np.isfinite(array).all():
        raise ValueError(f"{name} has numbers that are not finite.")
    return array
