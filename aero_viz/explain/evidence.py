"""A plan with everything that led to it: the tick is planned again, and the intermediate results are kept."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_planner import Plan, Planner
from aero_viz.errors import UserError
from aero_viz.explain.terms import (
    STAGE2,
    Obstacles,
    Problem,
    Rollouts,
    collision_cost,
    roll_out,
    stage1_terms,
    stage2_terms,
    step_times,
)
from aero_viz.session.frame import Frame
from aero_viz.session.safety import Safety, judge

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Stage1:
    """Stage I of one instance with K samples."""

    terms: Array
    """Terms `STAGE1` of every sample at each step, shape [terms, K, N]."""
    weights: Array
    """Weights of the samples in the update, which sum to one, shape [K]."""

    @property
    def best(self) -> int:
        """Sample with the lowest S1."""
        return int(self.weights.argmax())

    @property
    def effective_samples(self) -> float:
        """Effective number of samples, 1 / sum(w^2)."""
        return float(1.0 / (self.weights**2).sum())


@dataclass(frozen=True, eq=False)
class Evidence:
    """Everything that led to a plan of M instances with N steps."""

    frame: Frame
    plan: Plan
    """The plan of the frame, planned again with its samples."""
    is_exact: bool
    """True if it equals that of the frame bit for bit."""
    problem: Problem
    waypoints: Array
    """Waypoint of the cost-to-go of each instance [m], shape [M, 3]."""
    terms: Array
    """Terms `STAGE2` of each instance at each step, shape [terms, M, N]."""
    distance: Array
    """Distance to the obstacles after each control [m], shape [M, N]; unlike `Plan.clearance` without an upper end."""
    safety: Safety
    """What the planner measured of the instances, and which of them are safe."""
    samples: tuple[Array, Array]
    """Controls [M, K, N, 4] and J_col at each step [M, K, N] of the samples."""
    start: tuple[Array, Array, Array]
    """Position, velocity and quaternion at which the plan takes effect."""
    control: tuple[Array, Array]
    """Controls in effect and commanded at the start, shape [4] each."""

    @property
    def is_safe(self) -> NDArray[np.bool_]:
        """True for each safe instance, shape [M]."""
        return self.safety.is_safe

    @property
    def has_stop(self) -> NDArray[np.bool_]:
        """True for each instance with a clear stop, shape [M]; true for all if no stop is proven."""
        if self.safety.stop_clearance is None:
            return np.ones(len(self.is_safe), dtype=np.bool_)
        return self.safety.stop_clearance >= self.safety.clear_stop

    def stage1(self, instance: int) -> Stage1:
        """Return Stage I of an instance."""
        plan, config = self.plan, self.frame.config
        controls, collision = self.samples[0][instance], self.samples[1][instance]
        model = roll_out(self.start, self.control[0], controls, config)
        assert plan.samples is not None
        x = Rollouts(plan.samples[instance, :, 1:].astype(np.float64), model.velocities, model.quaternions)
        kind = config.kinds[instance]
        guide = None if kind == "previous" else self._guide(instance)
        terms = stage1_terms(
            x, controls, guide, self.control[1], self.waypoints[instance], self.problem, collision=collision
        )
        cost = plan.stage1_cost[instance].astype(np.float64)
        weights = np.exp((cost.min() - cost) / config.sampling.temperature)
        return Stage1(terms, weights / weights.sum())

    def _guide(self, instance: int) -> Array:
        times = self.frame.config.sampling.dt * np.arange(1, self.plan.controls.shape[1] + 1)
        return (self.plan.guide_coefficients[instance].astype(np.float64) @ times[None] ** np.arange(6)[:, None]).T


class Replanner:
    """Plans frames again, on a separate planner, so that the session's is not disturbed."""

    def __init__(self) -> None:
        self._planner: Planner | None = None
        self._key: tuple[Any, ...] = ()

    def __call__(self, frame: Frame) -> Evidence:
        """Return the evidence of a frame.

        Raises:
            UserError: the tick of the frame cannot be repeated, such as one that a drone has sent.
        """
        if frame.checkpoint is None:
            raise UserError(
                "This plan cannot be explained term by term: the drone sends neither its samples nor the state of its "
                "planner. Its own log can be played and explained."
            )
        planner = self._configured(frame)
        planner.restore(frame.checkpoint.planner)
        return _evidence(frame, frame.observation.plan_with(planner, samples=True), planner)

    def close(self) -> None:
        """Release the planner."""
        if self._planner is not None:
            self._planner.close()
            self._planner = None

    def _configured(self, frame: Frame) -> Planner:
        key = (frame.device, frame.seed)
        if self._planner is None or key != self._key:
            self.close()
            self._key = key
            self._planner = Planner(frame.config, device=key[0], seed=key[1])
        elif self._planner.config is not frame.config:
            self._planner.configure(frame.config)
        return self._planner


def _evidence(frame: Frame, plan: Plan, planner: Planner) -> Evidence:
    config, work, checkpoint = frame.config, planner.workspace, frame.checkpoint
    assert checkpoint is not None
    M, K = plan.stage1_cost.shape

    def read(name: str) -> Any:
        return getattr(work, name).numpy()[0].astype(np.float64)

    waypoints, goal = read("waypoints")[:M], np.asarray(frame.observation.goal.position, dtype=np.float64)
    waypoints[[kind == "brake" for kind in plan.kinds]] = goal
    points = np.asarray(plan.filtered_points)
    places = checkpoint.planner.places[0, : int(checkpoint.planner.place_count[0])]
    problem = Problem(
        config,
        (goal, read("goal_velocity"), read("goal_quaternion")),
        Obstacles(points, frame.observation.ground_height, config, plan.moving),
        places.astype(np.float64),
        float(checkpoint.planner.place_nearest[0]),
    )
    states = (plan.positions, plan.velocities, plan.quaternions)
    x = Rollouts(*(array[:, 1:].astype(np.float64) for array in states))
    distance = problem.obstacles.distance(x.positions, step_times(x.positions, config))
    controls, command = plan.controls.astype(np.float64), read("command")
    terms = stage2_terms(x, controls, command, waypoints, problem, collision=collision_cost(distance, config))
    is_previous = [kind == "previous" for kind in plan.kinds]
    terms[STAGE2.index("escape"), is_previous] *= 1.0 - config.escape.previous_discount
    instance_of = np.s_[: plan.controls.shape[1]]
    return Evidence(
        frame=frame,
        plan=plan,
        is_exact=_equal(plan, frame.plan),
        problem=problem,
        waypoints=waypoints,
        terms=terms,
        distance=distance,
        safety=judge(planner, best=int(plan.best), status=int(plan.status)),
        samples=(
            work.sample_controls.numpy()[..., :K].astype(np.float64).transpose(0, 3, 1, 2),
            work.sample_clearance_cost.numpy()[:, instance_of, :K].astype(np.float64).transpose(0, 2, 1),
        ),
        start=(read("position"), read("velocity"), read("quaternion")),
        control=(read("control"), command),
    )


def _equal(a: Plan, b: Plan) -> bool:
    return a.best == b.best and a.kinds == b.kinds and np.array_equal(a.stage2_cost, b.stage2_cost)
