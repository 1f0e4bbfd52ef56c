"""Costs by term add up to those of the planner, and the safe instances are those that it chooses from."""

import dataclasses
import re

import numpy as np
import pytest

from aero_planner import PlannerConfig, PlanStatus
from aero_viz.catalog import open_source
from aero_viz.errors import UserError
from aero_viz.explain.verdict import verdict
from aero_viz.flight import FlightSource, VehicleModel
from aero_viz.flight.known_drone import config_for_flight
from aero_viz.scenes import scene as make_scene
from aero_viz.session import Session
from tests.explain.conftest import evidence_of

FLIGHTS = (
    ("forest", 60, 15, "default"),
    ("double_wall_trap", 36, 12, "default"),
    ("verticals", 80, 20, "paper"),
    ("verticals", 40, 20, "px4"),
    ("double_wall_trap", 32, 16, "paper"),
)


def check_costs(evidence):
    """Check the terms of all instances and of their best samples against the sums of the planner."""
    plan, first, second = evidence.frame.plan, evidence.stage1, evidence.stage2
    assert evidence.is_exact
    names = [term.name for term in second.terms]
    assert second.values.shape == (len(plan.kinds), len(names), plan.controls.shape[1])
    np.testing.assert_allclose(second.values.sum(axis=(1, 2)), plan.stage2_cost, rtol=1e-5)
    goal = [term.sum == "J_goal" for term in second.terms]
    np.testing.assert_allclose(second.values[:, goal].sum(axis=(1, 2)), plan.goal_cost, rtol=1e-5)
    np.testing.assert_allclose(second.values_of("obstacles").sum(axis=1), plan.collision_cost, rtol=1e-5)
    np.testing.assert_allclose(first.values.sum(axis=(1, 2)), plan.stage1_cost.min(axis=1), rtol=1e-5)
    assert len(first.terms) > len(names)
    for m, costs in enumerate(plan.stage1_cost):
        assert evidence.weights[m].argmax() == costs.argmin()
        assert 1.0 <= evidence.effective_samples(m) <= len(costs)
    np.testing.assert_allclose(evidence.weights.sum(axis=1), 1.0)


@pytest.mark.parametrize("flight", FLIGHTS)
def test_terms_add_up_to_the_costs_of_the_planner(flight):
    for evidence in evidence_of(*flight):
        check_costs(evidence)


WIDE = {"candidates.safe_clearance": 0.5, "stop_proof.stop_clearance": 0.5}
"""Changes with which many instances are unsafe."""
REAL = {"thrust_lag": 0.04, "rate_lag": 0.03, "drag": 0.3, "gust_speed": 4.0, "latency": 0.02}
DRONES = {
    "drag and gusts": ("forest", {"drag": 0.3, "gust_speed": 4.0}, {}, 139),
    "lags and latency": ("forest", REAL, {"vehicle.thrust_lag": 0.04, "vehicle.rate_lag": 0.03}, 60),
    "moving obstacles": ("moving", REAL, {}, 60),
    "slow": ("double_wall_trap", REAL, {"vehicle.speed_limit": 2.0}, 60),
    "few stages": ("forest", REAL, {"stages.active": "unseen_space, disturbance"}, 40),
    "acceleration": ("forest", {}, {"vehicle.model": "acceleration"}, 1),
    **{preset: ("forest", REAL, PlannerConfig().differences(PlannerConfig.preset(preset)), 40)
       for preset in PlannerConfig.presets()},
}  # fmt: skip


@pytest.mark.parametrize("name", DRONES)
def test_terms_add_up_for_a_drone_that_is_not_its_model(replan, name: str):
    scene, drone, changes, ticks = DRONES[name]
    changes = {path: value[1] if isinstance(value, tuple) else value for path, value in changes.items()}
    config = PlannerConfig().replace(changes)
    vehicle = VehicleModel.from_config(config, **drone)
    session = Session(FlightSource(make_scene(scene, seed=3), vehicle=vehicle, seed=3), config=config, seed=3)
    frames = [session.tick() for _ in range(ticks)][:: -max(ticks // 3, 1)]
    session.close()
    for frame in frames:
        check_costs(replan(frame))


@pytest.mark.parametrize("flight", FLIGHTS)
def test_every_instance_has_its_sentence(flight):
    for evidence in evidence_of(*flight):
        plan, best = evidence.frame.plan, int(evidence.frame.plan.best)
        sentences = [verdict(evidence, m) for m in range(len(plan.kinds))]
        if plan.status == PlanStatus.OK:
            assert f"Instance {best} won" in sentences.pop(best)
            assert all(f"lost to {best}: " in sentence or "is unsafe: " in sentence for sentence in sentences)
        else:
            cause = "The cheapest candidate is not safe" if flight[-1] == "paper" else "No candidate is safe"
            assert all(cause in sentence for sentence in sentences)


def test_a_sentence_names_term_time_and_obstacle():
    sentences = [verdict(e, m) for e in evidence_of(*FLIGHTS[1]) for m in range(15)]
    named = r"Instance \d+ lost to \d+: .*\d+ more for obstacles between [\d.]+ and [\d.]+ s, [\d.]+ m from box \d+\."
    assert any(re.fullmatch(named, sentence) for sentence in sentences), sentences


@pytest.mark.parametrize(("prove_stop", "distance_max"), [(False, 0.31), (False, 0.55), (True, 0.31)])
def test_a_drone_that_is_far_above_a_lower_speed_limit_is_not_unsafe_for_that(
    replan, prove_stop: bool, distance_max: float
):
    """Clearances are measured as far as its real speed asks for."""
    changes = {"stop_proof.prove_stop": prove_stop, "costs.distance_max": distance_max, "sampling.samples": 64}
    session = Session(open_source("forest", seed=3), config=PlannerConfig().replace(changes))
    for _ in range(60):
        session.tick()
    session.configure({"vehicle.speed_limit": 0.5})
    evidence = replan(session.tick())
    session.close()
    sentences = [verdict(evidence, int(m)) for m in np.flatnonzero(~evidence.is_safe)]
    assert evidence.is_safe.sum() > 5
    assert not any("above the speed limit" in sentence or "the ground" in sentence for sentence in sentences), sentences


def test_a_sentence_says_whether_the_stop_or_the_clearance_is_missing(replan):
    session = Session(open_source("double_wall_trap", seed=1), config=PlannerConfig().replace(WIDE), seed=1)
    frames = [session.tick() for _ in range(24)][11::3]
    session.close()
    sentences = []
    for frame in frames:
        evidence = replan(frame)
        check_costs(evidence)
        refused = evidence.safety.refused_by["stop_proof"] & (np.arange(16) != evidence.plan.best)
        sentences += [verdict(evidence, int(m)) for m in np.flatnonzero(refused)]
    assert "brake" in [kind for frame in frames for kind in frame.plan.kinds], "costs of a stop were checked, too"
    assert sentences and all("no stop that leaves it stays clear" in sentence for sentence in sentences)
    near = [evidence for evidence in evidence_of(*FLIGHTS[4]) if not evidence.is_safe.all()]
    assert near and not any(evidence.safety.refused_by for evidence in near), "the paper proves no stops"
    sentences = [verdict(evidence, int(m)) for evidence in near for m in np.flatnonzero(~evidence.is_safe)]
    assert any(re.search(r"it comes within [\d.]+ m of .* at [\d.]+ s, where 0\.25 m are asked", s) for s in sentences)


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_a_frame_knows_the_safe_instances_without_an_explanation(replan, preset: str):
    source = open_source("double_wall_trap", seed=1)
    wide = PlannerConfig.preset(preset).replace(WIDE)
    session = Session(source, config=config_for_flight(wide, source.info), seed=1)
    for _ in range(15):
        session.tick()
    assert session.frame is not None and session.frame.is_safe is None, "it takes time, so only on demand"
    session.judge_candidates().result()
    frames = [session.frame, *[session.tick() for _ in range(8)]][::4]
    session.close()
    safe = [replan(frame).is_safe for frame in frames]
    np.testing.assert_array_equal([frame.is_safe for frame in frames], safe)
    assert not np.all(safe)


def test_a_plan_of_a_drone_cannot_be_explained(replan):
    frame = evidence_of(*FLIGHTS[1])[0].frame
    with pytest.raises(UserError, match="own log"):
        replan(dataclasses.replace(frame, checkpoint=None))
