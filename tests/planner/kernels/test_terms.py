"""The terms of `Planner.cost_terms`: their sums are the planner's, and each is its equation."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from aero_planner import Goal, Plan, Planner, PlannerConfig, PlanStatus, VehicleState
from aero_planner.cost_terms import CostTerms
from tests.planner import reference
from tests.planner.cases import assert_same, batch_of, config_of, kept_points, level_case, random_case
from tests.planner.pillars import GOAL, closing_in, plan_from, sweeps_of
from tests.planner.reference import Array


@dataclass
class Situation:
    """A planner and its last plan."""

    planner: Planner
    plan: Plan
    goal: tuple[Array, Array, Array]


def clutter(device: str, config: PlannerConfig, *, plans: int = 2, cloud_age: float = 0.0) -> Situation:
    """Return the last of some plans in clutter."""
    planner, case = Planner(config, device=device), random_case(1, nearest=0.8, count=500, speed=5.0)
    for _ in range(plans):
        plan = case.plan(planner, cloud_age=cloud_age)
    return Situation(planner, plan, case.full_goal())  # pyright: ignore[reportPossiblyUnboundVariable]


def gusts(device: str, config: PlannerConfig) -> Situation:
    """Return a plan of a drone whose drag and disturbance the planner has estimated."""
    planner, case = Planner(config, device=device), random_case(2, nearest=1.0, count=300)
    case.velocity = np.array([4.0, 1.0, 0.0])
    for k in range(8):
        given = np.array([0.5, 0.6, -0.4]) - 0.3 * case.velocity
        state = VehicleState(case.position, case.velocity, case.quaternion, time=0.1 * k, disturbance=given)
        plan = planner.plan(state, Goal(case.goal), case.points)
    assert plan.drag > 0.05 and np.linalg.norm(plan.disturbance) > 0.3  # pyright: ignore
    return Situation(planner, plan, case.full_goal())  # pyright: ignore[reportPossiblyUnboundVariable]


def moving(device: str, config: PlannerConfig) -> Situation:
    """Return a plan with a dynamic obstacle in the way."""
    planner = Planner(config, device=device)
    sweeps, position = sweeps_of([(np.array([2.0, 1.5]), np.array([0.0, -1.5]))], np.zeros(3))
    plan = plan_from(planner, sweeps, position)
    assert plan.moving is not None and len(plan.moving.positions) == 1
    return Situation(planner, plan, (np.asarray(GOAL.position), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])))


def stuck(device: str, config: PlannerConfig) -> Situation:
    """Return a plan of a drone that has remembered places."""
    planner, case = Planner(config, device=device), random_case(3, nearest=1.0, count=300, speed=0.5)
    for k in range(12):
        state = VehicleState(case.position, case.velocity, case.quaternion, case.acceleration, time=0.1 * k)
        plan = planner.plan(state, Goal(case.goal), case.points)
    assert planner.history().arrays["place_count"][0] > 2
    return Situation(planner, plan, case.full_goal())  # pyright: ignore[reportPossiblyUnboundVariable]


def braking(device: str, config: PlannerConfig) -> Situation:
    """Return a plan in which a braking candidate has replaced the best instance."""
    situation = clutter(device, config, cloud_age=9.0)
    assert situation.plan.status == PlanStatus.STALE_CLOUD
    return situation


def stopping(device: str, config: PlannerConfig) -> Situation:
    """Return a plan in which the proven stop has replaced the best instance."""
    planner = Planner(config, device=device)
    case, sweeps = level_case(speed=3.0), closing_in()
    arrival = sweeps.arrivals[-1]
    assert arrival is not None
    state = replace(case.state, time=arrival.time)
    planner.plan(state, Goal(case.goal), case.points)
    plan = planner.plan(replace(state, time=arrival.time + 0.02), Goal(case.goal), sweeps)
    assert planner.outputs.flown.numpy()[0] == planner.outputs.controls.shape[1] - 1
    return Situation(planner, plan, case.full_goal())


Make = Callable[[str, PlannerConfig], Situation]
SITUATIONS: dict[str, tuple[Make, str, dict[str, Any]]] = {
    "default": (clutter, "default", {}),
    "paper": (clutter, "paper", {}),
    "fast-cpu": (clutter, "fast-cpu", {}),
    "px4": (clutter, "px4", {}),
    "first plan": (lambda device, config: clutter(device, config, plans=1), "default", {}),
    "gusts": (gusts, "default", {"disturbance__disturbance_time": 0.2, "disturbance__drag_time": 1.0}),
    "lags": (clutter, "default", {"vehicle__thrust_lag": 0.06, "vehicle__rate_lag": 0.09}),
    "delay": (clutter, "default", {"vehicle__delay": 0.07, "vehicle__rate_lag": 0.05}),
    "gusts with lags and a delay": (
        gusts,
        "px4",
        {"disturbance__disturbance_time": 0.2, "disturbance__drag_time": 1.0, "vehicle__delay": 0.05},
    ),
    "dynamic obstacles": (moving, "default", {}),
    "remembered places": (stuck, "default", {}),
    "braking": (braking, "default", {}),
    "proven stop": (stopping, "default", {"sampling__dt": 0.05}),
}
SAMPLES = [(0, 0), (0, 7), (7, 15), (14, 3)]


@pytest.fixture(scope="module", params=SITUATIONS)
def situation(request: pytest.FixtureRequest, device: str) -> Situation:
    make, preset, changes = SITUATIONS[request.param]
    return make(device, config_of(preset, costs__q_control_jump=2.0, **changes))


@pytest.fixture(scope="module")
def terms(situation: Situation) -> CostTerms:
    """Terms of all instances, then of some samples."""
    return situation.planner.cost_terms(range(len(situation.plan.kinds)), SAMPLES)


def away_from_steps(terms: CostTerms, situation: Situation) -> np.ndarray:
    """Return the rollouts whose costs rounding does not move across a step of the penalties or of the cost-to-go."""
    costs, plan = situation.planner.config.costs, situation.plan
    # Clearances that are truncated at an edge are beyond it.
    gaps = [np.abs(terms.clearance - edge) for edge in (costs.distance_min, costs.distance_max)]
    is_away = np.all([np.where(gap > 1e-7, gap, 1.0).min(axis=1) > 1e-5 for gap in gaps], axis=0)
    for i, end in enumerate(terms.positions[:, -1].astype(np.float64)):
        places, _ = reference.probes(end, situation.goal[0], situation.planner.config)
        is_away[i] &= np.abs(reference.clearance(places, kept_points(plan), 9.0) - costs.distance_min).min() > 1e-5
    return is_away


def test_they_sum_up_to_the_costs_of_the_plan(situation: Situation, terms: CostTerms):
    plan, M = situation.plan, len(situation.plan.kinds)
    is_away = away_from_steps(terms, situation)
    # Both are sums of float32 in another order, whose positions are rounded to 2e-6 m at a steepness of 3e5 1/m.
    tolerance: dict[str, Any] = {"rtol": 2e-6, "atol": 1.0 if terms.stage2_cost.max() > 1e5 else 2e-3}
    np.testing.assert_allclose(terms.stage2_cost[:M][is_away[:M]], plan.stage2_cost[is_away[:M]], **tolerance)
    sampled = np.array([plan.stage1_cost[m, k] for m, k in SAMPLES])
    np.testing.assert_allclose(terms.stage1_cost[M:][is_away[M:]], sampled[is_away[M:]], **tolerance)
    assert is_away[:M].sum() > M // 2 and is_away[M:].any()


def test_their_rollouts_are_those_of_the_plan(situation: Situation, terms: CostTerms):
    plan, M = situation.plan, len(situation.plan.kinds)
    config = situation.planner.config
    row = situation.planner.outputs.flown.numpy()[0]
    positions, clearance = plan.positions[:, 1:].copy(), plan.clearance.copy()
    # While a proven stop is flown, a plan holds its mean control in the first step.
    positions[plan.best] = situation.planner.outputs.positions.numpy()[0, row, 1:]
    np.testing.assert_allclose(terms.positions[:M], positions, atol=2e-5)
    np.testing.assert_allclose(np.minimum(terms.clearance[:M], config.costs.distance_max), clearance, atol=3e-5)


def test_each_is_its_equation(situation: Situation, terms: CostTerms):
    planner, plan, (p_goal, v_goal, _) = situation.planner, situation.plan, situation.goal
    q_goal = planner.workspace.goal_quaternion.numpy()[0].astype(np.float64)  # test_anchors checks it
    config, work, M = planner.config, planner.workspace, len(situation.plan.kinds)
    start = {name: getattr(work, name).numpy()[0].astype(np.float64) for name in (
        "position", "velocity", "quaternion", "command", "control",
    )}  # fmt: skip
    disturbance, drag = planner.outputs.disturbance.numpy()[0].astype(float), float(planner.outputs.drag.numpy()[0])
    previous = config.kinds.index("previous") if "previous" in config.kinds else -1
    replaced, flown = planner.outputs.braking_instance.numpy()[0], planner.outputs.flown.numpy()[0]
    rows = [int(flown) if m == replaced else m for m in range(M)]
    controls = [planner.outputs.controls.numpy()[0, row] for row in rows]
    controls += [work.sample_controls.numpy()[m, :, :, k] for m, k in SAMPLES]
    values = {term.name: terms.values[:, i] for i, term in enumerate(terms.terms)}
    assert ("escape" in values) == ("way_out" in config.stages.names)
    history = planner.history().arrays
    limit = max(
        config.costs.distance_max,
        config.candidates.safe_clearance + config.candidates.speed_margin * config.vehicle.speed_limit,
    )
    for i, (row, u) in enumerate(zip([*rows, *(m for m, _ in SAMPLES)], controls, strict=True)):
        u = u.astype(np.float64)
        x = reference.roll_out(
            start["position"], start["quaternion"], start["velocity"], u, config, start["control"], disturbance, drag
        )
        guide = planner.outputs.guides.numpy()[0, row, 1:].astype(np.float64)
        expected = {
            "guide_tracking": 0.0 * u[:, 0] if row == previous else reference.J_track(x.p, guide, config),
            "speed": reference.J_vnorm(x.v, config),
            "control_effort": reference.J_effort(u, config),
            "control_change": reference.J_change(u, config),
            "goal_position": reference.J_position(x.p, p_goal, config),
            "goal_velocity": reference.J_velocity(x.v, v_goal, config),
            "goal_attitude": reference.J_attitude(x.q, q_goal, config),
            "speed_limit": reference.J_speed(x.v, config),
            "control_jump": reference.J_jump(u, start["command"], config),
        }
        if "unseen_space" in config.stages.names:
            expected["tilt"] = reference.J_tilt(x.q, config)
        for name, steps in expected.items():
            # Rollouts agree to 1e-4 m and m/s, which the weight of the speed limit multiplies by up to 4000.
            atol = 0.1 if name == "speed_limit" else 2e-3
            np.testing.assert_allclose(values[name][i], steps, rtol=2e-4, atol=atol, err_msg=f"{name} of {i}")
        np.testing.assert_allclose(
            values["obstacles"][i], reference.J_col(terms.clearance[i].astype(np.float64), config), rtol=1e-4, atol=1e-2
        )
        p = terms.positions[i].astype(np.float64)
        d = reference.clearance(p, kept_points(plan), limit)
        if plan.moving is not None:
            t = config.sampling.dt * np.arange(1, len(p) + 1)
            pillars = zip(plan.moving.positions, plan.moving.velocities, plan.moving.radii, strict=True)
            for place, velocity, radius in pillars:
                gap = np.linalg.norm(p[:, :2] - place - t[:, None] * velocity, axis=1) - radius - 0.1 * t
                d = np.minimum(d, np.maximum(gap, 0.0))
        np.testing.assert_allclose(terms.clearance[i], d, atol=2e-5)
        ends = {"blocked_path": reference.J_blocked(p[-1], p_goal, kept_points(plan), config)}
        if "escape" in values:
            places = history["places"][0, : history["place_count"][0]].astype(np.float64)
            nearest = float(history["place_nearest"][0])
            ends["escape"] = reference.J_escape(p[-1], places, nearest, p_goal, config)
        for name, end in ends.items():
            if name == "escape" or away_from_steps(terms, situation)[i]:
                np.testing.assert_allclose(values[name][i], [*[0.0] * (len(p) - 1), end], rtol=1e-4, atol=0.02)
        assert set(expected) | set(ends) | {"obstacles"} == set(values)


def test_explaining_a_plan_changes_nothing(device: str):
    planner, untouched = (Planner(config_of(), device=device) for _ in range(2))
    for seed in range(3):
        assert_same(random_case(seed).plan(planner), random_case(seed).plan(untouched))
        planner.cost_terms([0, 3], [(1, 1)])


def test_of_a_batch_they_are_those_of_the_first_drone(device: str):
    cases = [random_case(seed) for seed in range(2)]
    batch, single = Planner(config_of(), device=device, batch=2), Planner(config_of(), device=device)
    batch.plan(*batch_of(cases))
    cases[0].plan(single)
    for name in ("values", "positions", "clearance"):
        ours, expected = (getattr(planner.cost_terms([0, 5], [(2, 2)]), name) for planner in (batch, single))
        np.testing.assert_array_equal(ours, expected)


def test_none_and_wrong_rollouts(device: str):
    planner = Planner(config_of(), device=device)
    random_case(0).plan(planner)
    assert planner.cost_terms().values.shape == (0, len(planner.cost_terms().terms), 25)
    for instances, samples in (([16], []), ([], [(0, 16)]), ([-1], [])):
        with pytest.raises(ValueError, match="a plan has 16 instances of 16 samples"):
            planner.cost_terms(instances, samples)
