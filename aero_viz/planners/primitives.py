"""A motion-primitive planner: quintics to end points around the goal direction, checked against the cloud.

NumPy and SciPy only. Every plan has end points at several angles and lengths, each reached by a quintic per axis from
the present position, velocity and acceleration. The cheapest path that keeps its clearance is flown, by its
acceleration. If there is none, the drone brakes along the path with the largest clearance.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from aero_planner import PlanStatus, VehicleState
from aero_planner.config import DroneConfig, ParameterSection, VehicleConfig
from aero_planner.parameters import live, structural
from aero_viz.planners.observation import Observation
from aero_viz.planners.plan import CandidatePlan
from aero_viz.planners.planner import Planner

Array = NDArray[np.float64]
_ACCELERATION_MAX = 9.0
"""Largest acceleration along a path [m/s^2]; thrust leaves little more."""
_VOXEL = 0.15
"""Size of the cells of which the cloud keeps one point each [m]."""
_STEP = 0.1
"""Time step of the paths [s]."""
_LEAD = 0.12
"""Time by which commands lead a path, since the attitude follows them with a lag [s]."""


@dataclass(frozen=True)
class PrimitiveSection(ParameterSection, section="paths"):
    """Paths: the fan of end points, and how the paths are judged."""

    columns: int = structural(11, 1, 61, "End points side by side.")
    rows: int = structural(3, 1, 31, "End points one above the other.")
    width: float = live(150.0, "deg", 0.0, 360.0, "Angle between the outermost end points.", basic=True)
    height: float = live(30.0, "deg", 0.0, 170.0, "Angle between the highest and the lowest end points.")
    horizon: float = live(1.6, "s", 0.3, 5.0, "Duration of a path.", basic=True)
    clearance: float = live(0.4, "m", 0.05, 5.0, "Smallest distance to a point of the cloud.", basic=True)
    margin: float = live(0.6, "m", 0.0, 5.0, "Distance beyond the clearance from which obstacles cost nothing.")
    q_goal: float = live(
        1.0, "1/m", 0.0, 1e3, "Weight of the distance from the end to the goal.", label="Goal weight", basic=True
    )
    q_obstacle: float = live(
        3.0, "1/m", 0.0, 1e3, "Weight of the missing margin, mean over the path.", label="Obstacle weight", basic=True
    )
    q_effort: float = live(0.02, "s^4/m^2", 0.0, 1e3, "Weight of the mean squared acceleration.", label="Effort weight")
    q_change: float = live(
        0.4,
        "1/m",
        0.0,
        1e3,
        "Weight of the distance from the end to that of the last plan.",
        label="Weight of a change",
    )
    cloud_age_max: float = live(0.5, "s", 0.0, 10.0, "Age of the cloud beyond which the drone brakes.")
    height_min: float = live(0.7, "m", -1e4, 1e4, "Lowest height above the ground.")
    height_max: float = live(1e4, "m", -1e4, 1e4, "Greatest height; in a flight by default the top of the world.")


@dataclass(frozen=True)
class PrimitiveConfig(DroneConfig):
    """The drone and the paths."""

    planner: ClassVar[str] = "primitives"

    vehicle: VehicleConfig = field(default_factory=lambda: VehicleConfig(model="acceleration", speed_limit=4.0))
    paths: PrimitiveSection = field(default_factory=PrimitiveSection)


class Primitives(Planner):
    """Chooses one of a fan of quintics."""

    Config = PrimitiveConfig

    def __init__(self, config: DroneConfig | None = None, *, device: str = "cpu", seed: int = 0) -> None:
        super().__init__(config, device=device, seed=seed)
        self._end: Array | None = None
        """End of the path that was chosen last [m], shape [3]."""
        self._thinned: dict[int, tuple[Any, Array]] = {}
        """Sweeps of the present cloud, each with its thinned points, by their identity."""
        self._tree: KDTree | None = None
        self._sweeps: Any = None
        self._reach = 0.0

    def history(self) -> Array | None:
        return self._end

    def restore(self, history: Any) -> None:
        self._end = history if isinstance(history, np.ndarray) else None

    def reset(self, *, seed: int | None = None) -> None:
        self._end = None

    def plan(self, observation: Observation) -> CandidatePlan:
        started = time.perf_counter()
        self._look(observation)
        looked = time.perf_counter()
        paths = self.config.paths
        times = _STEP * np.arange(max(round(paths.horizon / _STEP), 2) + 1)
        ends, speeds = self._ends(observation)
        positions, accelerations = quintics(observation.state, ends, speeds, times)
        clearance = self._clearance(positions[:, 1:], observation)
        effort = np.linalg.norm(accelerations, axis=-1)
        is_safe = (clearance.min(axis=1) >= paths.clearance) & (effort.max(axis=1) < _ACCELERATION_MAX)
        missing = np.clip(paths.clearance + paths.margin - clearance, 0.0, None)
        change = np.zeros(len(ends)) if self._end is None else np.linalg.norm(ends - self._end, axis=1)
        costs = {
            "goal": paths.q_goal * np.linalg.norm(positions[:, -1] - np.asarray(observation.goal.position), axis=1),
            "obstacles": paths.q_obstacle * missing.mean(axis=1),
            "effort": paths.q_effort * (effort**2).mean(axis=1),
            "change": paths.q_change * change,
        }
        moves = len(ends) - 1  # the last path brakes
        cost = np.where(is_safe, sum(costs.values()), np.inf)[:moves]
        is_stale = observation.cloud_age > paths.cloud_age_max
        best = int(cost.argmin()) if is_safe[:moves].any() and not is_stale else moves
        status = PlanStatus.OK if best < moves else PlanStatus.NO_SAFE_CANDIDATE
        self._end = ends[best] if best < moves else None
        done = time.perf_counter()
        return CandidatePlan(
            positions=positions,
            costs=costs,
            best=best,
            step=_STEP,
            status=PlanStatus.STALE_CLOUD if is_stale else status,
            controls=self._controls(times, accelerations[best], observation),
            clearance=clearance,
            is_safe=is_safe,
            kinds=("path",) * moves + ("brake",),
            stage_ms={
                "cloud": 1e3 * (looked - started),
                "paths": 1e3 * (done - looked),
                "total": 1e3 * (done - started),
            },
        )

    def _look(self, observation: Observation) -> None:
        """Build the tree of the cloud's points, if a sweep has arrived; points are thinned once per sweep."""
        reach = 1.0 + 1.2 * self.config.paths.horizon * self.config.vehicle.speed_limit
        if observation.sweeps is self._sweeps and reach <= self._reach:
            return
        self._sweeps, self._reach = observation.sweeps, reach
        known = self._thinned
        self._thinned = {id(s): known.get(id(s)) or (s, _thin(s)) for s in observation.sweeps}
        points = np.concatenate([np.zeros((0, 3)), *(thin for _, thin in self._thinned.values())])
        near = points[np.linalg.norm(points - np.asarray(observation.state.position), axis=1) < reach]
        self._tree = KDTree(near) if len(near) else None

    def _ends(self, observation: Observation) -> tuple[Array, Array]:
        """Return end points [m] and the velocities there [m/s], each of shape [M, 3]; the last one brakes."""
        paths, limit = self.config.paths, self.config.vehicle.speed_limit
        state = observation.state
        position, velocity = np.asarray(state.position, float), np.asarray(state.velocity, float)
        to_goal = np.asarray(observation.goal.position, dtype=np.float64) - position
        distance = float(np.linalg.norm(to_goal))
        azimuth = np.arctan2(to_goal[1], to_goal[0]) + np.radians(paths.width) * _spread(paths.columns)
        elevation = np.arctan2(to_goal[2], np.hypot(*to_goal[:2])) + np.radians(paths.height) * _spread(paths.rows)
        a, e, share = (grid.ravel() for grid in np.meshgrid(azimuth, elevation, (1.0, 0.55, 0.25), indexing="ij"))
        directions = np.stack((np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)), axis=1)
        length = np.minimum(0.9 * share * limit * paths.horizon, distance)
        speed = np.where(length < distance, share * limit, 0.0)
        stop = position + 0.35 * paths.horizon * velocity
        ends = np.vstack((position + length[:, None] * directions, stop))
        return ends, np.vstack((speed[:, None] * directions, np.zeros(3)))

    def _clearance(self, positions: Array, observation: Observation) -> Array:
        """Return the distance of each position [m], shape [M, N, 3], to the cloud and the limits of the height [m]."""
        paths = self.config.paths
        near = np.full(positions.shape[:-1], paths.clearance + paths.margin)  # beyond, obstacles cost nothing
        if self._tree is not None:
            near = np.minimum(near, self._tree.query(positions, distance_upper_bound=near.flat[0])[0])
        z = positions[..., 2]
        floor = -np.inf if observation.ground_height is None else observation.ground_height + paths.height_min
        level = np.minimum(z - floor, paths.height_max - z) + paths.clearance
        return np.clip(np.minimum(near, level), 0.0, None)

    def _controls(self, times: Array, accelerations: Array, observation: Observation) -> Array:
        """Return accelerations and yaw rates that follow a path, with the nose toward the goal, shape [N, 4]."""
        w, x, y, z = np.asarray(observation.state.quaternion, dtype=np.float64)
        yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        to_goal = np.asarray(observation.goal.position) - np.asarray(observation.state.position)
        turn = (np.arctan2(to_goal[1], to_goal[0]) - yaw + np.pi) % (2.0 * np.pi) - np.pi
        limit = self.config.vehicle.rate_z_max
        ahead = [np.interp(times + _LEAD, times, axis) for axis in accelerations.T]
        return np.stack((*ahead, np.full(len(times), np.clip(2.0 * turn, -limit, limit))), axis=1)


def quintics(state: VehicleState, ends: Array, speeds: Array, times: Array) -> tuple[Array, Array]:
    """Return positions and accelerations of quintics that end at `ends` with `speeds` and without acceleration.

    Args:
        state: start; an acceleration that is unknown is zero.
        ends: [m], shape [M, 3].
        speeds: velocities at the ends [m/s], shape [M, 3].
        times: from 0 to the duration T [s], shape [N+1].

    Returns:
        [m] and [m/s^2], each of shape [M, N+1, 3].
    """
    p0, v0 = np.asarray(state.position, dtype=np.float64), np.asarray(state.velocity, dtype=np.float64)
    a0 = np.zeros(3) if state.acceleration is None else np.asarray(state.acceleration, dtype=np.float64)
    T = float(times[-1])
    p, v, a = ends - p0 - v0 * T - 0.5 * a0 * T**2, (speeds - v0 - a0 * T) * T, -a0 * T**2
    c3, c4, c5 = 10.0 * p - 4.0 * v + 0.5 * a, -15.0 * p + 7.0 * v - a, 6.0 * p - 3.0 * v + 0.5 * a
    t, s = times[:, None], times[:, None] / T
    rest = c3[:, None] * s**3 + c4[:, None] * s**4 + c5[:, None] * s**5
    bend = (6.0 * c3[:, None] * s + 12.0 * c4[:, None] * s**2 + 20.0 * c5[:, None] * s**3) / T**2
    return p0 + v0 * t + 0.5 * a0 * t**2 + rest, a0 + bend


def _spread(count: int) -> Array:
    """Return `count` numbers around 0, the outermost ones 1 apart."""
    return np.linspace(-0.5, 0.5, count) if count > 1 else np.zeros(1)


def _thin(sweep: NDArray[np.float32]) -> Array:
    """Return one point of each cell of `_VOXEL` in which a sweep has any."""
    points = sweep[np.isfinite(sweep).all(axis=1)]
    cells = np.floor(points / _VOXEL).astype(np.int64) + 2**20
    _, rows = np.unique((cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2], return_index=True)
    return points[rows].astype(np.float64)
