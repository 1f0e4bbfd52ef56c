"""A plan with everything that led to it: the tick is planned again, and the planner splits its costs by term."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner import Plan, VehicleState
from aero_planner import Planner as Core
from aero_planner.cost_terms import CostTerms
from aero_planner.plan import BrakingCandidates
from aero_planner.safety import Safety
from aero_planner.stages.way_out.places import PLACES
from aero_viz.errors import UserError
from aero_viz.explain.obstacles import Obstacles
from aero_viz.planners.aero_mppi import AeroMppi
from aero_viz.planners.plan import Plan as AnyPlan
from aero_viz.planners.plan import ensemble
from aero_viz.planners.planner import Planner, PlannerError
from aero_viz.planners.registry import make
from aero_viz.session.engine import reconfigured
from aero_viz.session.frame import Frame
from aero_viz.session.safety import known_safe

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PlanEvidence:
    """What every planner tells of a plan of M candidates."""

    frame: Frame
    plan: AnyPlan
    """The plan of the frame, planned again."""
    is_exact: bool
    """True if it equals that of the frame bit for bit."""
    is_safe: NDArray[np.bool_]
    """True for each safe candidate as far as that is known, shape [M]."""


@dataclass(frozen=True, eq=False)
class Evidence(PlanEvidence):
    """Everything that led to a plan of M instances with K samples and N steps."""

    plan: Plan  # type: ignore[assignment]
    stage2: CostTerms
    """Terms of S2 of each instance; of one that a stop has replaced, those of the stop."""
    stage1: CostTerms
    """Terms of S1 of the best sample of each instance."""
    weights: Array
    """Weights of the samples in the update of each instance, which sum to one, shape [M, K]."""
    obstacles: Obstacles
    """What the plan knows of obstacles."""
    distance: Array
    """Distance to them after each control [m], shape [M, N]; unlike `Plan.clearance` without an upper end."""
    safety: Safety
    """The planner's judgement of the instances."""
    places: int
    """Number of local minima in the tabu memory."""

    @property
    def times(self) -> Array:
        """Time of each step in the plan [s], shape [N]."""
        return self.frame.config.sampling.dt * np.arange(1, self.plan.controls.shape[1] + 1)

    def effective_samples(self, instance: int) -> float:
        """Return the effective number of samples of an instance, 1 / sum(w^2)."""
        return float(1.0 / (self.weights[instance] ** 2).sum())


class Replanner:
    """Plans frames again, on a separate planner, so that the session's is not disturbed."""

    def __init__(self) -> None:
        self._planner: Planner | None = None
        self._key: tuple[Any, ...] = ()

    def __call__(self, frame: Frame) -> PlanEvidence:
        """Return the evidence of a frame: `Evidence` if the planner is AERO-MPPI, otherwise what its plan holds.

        Raises:
            UserError: the tick of the frame cannot be repeated, such as one that a drone has sent.
        """
        plan, planner = self._planned(frame)
        full = ensemble(plan)
        if full is not None and isinstance(planner, AeroMppi):
            return _evidence(frame, full, planner.core)
        judged = planner.judge(plan)
        is_safe = known_safe(dataclasses.replace(frame, plan=plan)) if judged is None else judged
        return PlanEvidence(frame, plan, _equal(plan, frame.plan), is_safe)

    def plan(self, frame: Frame) -> AnyPlan:
        """Return the plan that the configuration of a frame makes at its tick, with its history; errors as above."""
        return self._planned(frame)[0]

    def _planned(self, frame: Frame) -> tuple[AnyPlan, Planner]:
        """Return the plan of a frame, and the planner that has made it."""
        if frame.checkpoint is None:
            raise UserError(
                "This plan cannot be explained term by term: the drone sends neither its samples nor the state of its "
                "planner. Its own log can be played and explained."
            )
        planner = self._restored(frame)
        try:
            return planner.attempt(frame.observation), planner
        except PlannerError as error:
            raise UserError(str(error)) from error

    def braking(self, frame: Frame, state: VehicleState) -> BrakingCandidates | None:
        """Return the braking candidates at the tick of a frame, which has a checkpoint, from another state.

        None if the planner has no such candidates.
        """
        planner = self._restored(frame)
        if not isinstance(planner, AeroMppi):
            return None
        return dataclasses.replace(frame.observation, state=state).plan_with(planner.core).braking

    def costs(self, frame: Frame, controls: ArrayLike) -> CostTerms | None:
        """Return the terms of S2 of controls [n, N, 4] that begin at the tick of a frame; None if not of AERO-MPPI."""
        planner = self._restored(frame)
        if not isinstance(planner, AeroMppi):
            return None
        frame.observation.plan_with(planner.core)
        return planner.core.costs_of(controls).of_stage2()

    def close(self) -> None:
        """Release the planner."""
        if self._planner is not None:
            self._planner.close()
            self._planner = None

    def _restored(self, frame: Frame) -> Planner:
        """Return the planner with the configuration and the history that it had before the tick of a frame."""
        assert frame.checkpoint is not None
        key = (frame.device, frame.seed)
        if self._planner is None or key != self._key:
            self.close()
            self._key = key
            self._planner = make(frame.config, device=key[0], seed=key[1])
        elif self._planner.config is not frame.config:
            self._planner = reconfigured(self._planner, frame.config, device=key[0], seed=key[1])
        self._planner.restore(frame.checkpoint.planner)
        return self._planner


def _evidence(frame: Frame, plan: Plan, planner: Core) -> Evidence:
    assert frame.checkpoint is not None
    (M, K), kept = plan.stage1_cost.shape, frame.checkpoint.planner.arrays
    stage1 = planner.cost_terms(samples=[(m, int(costs.argmin())) for m, costs in enumerate(plan.stage1_cost)])
    weights = planner.workspace.sample_weights.numpy()[:M, :K].astype(np.float64)
    obstacles = Obstacles(np.asarray(plan.filtered_points), frame.observation.ground_height, frame.config, plan.moving)
    safety = planner.safety()
    positions = plan.positions[:, 1:].astype(np.float64)
    times = frame.config.sampling.dt * np.arange(1, positions.shape[1] + 1)
    return Evidence(
        frame=frame,
        plan=plan,
        is_exact=_equal(plan, frame.plan),
        is_safe=safety.is_safe,
        stage2=planner.cost_terms(range(M)).of_stage2(),
        stage1=stage1.of_stage1(),
        weights=weights / weights.sum(axis=1, keepdims=True),
        obstacles=obstacles,
        distance=obstacles.distance(positions, times),
        safety=safety,
        places=min(int(kept["place_count"][0]), int(PLACES)) if "place_count" in kept else 0,
    )


def _equal(a: AnyPlan, b: AnyPlan) -> bool:
    return bool(a.best == b.best and a.kinds == b.kinds and np.array_equal(a.cost, b.cost))
