"""Costs by term add up to those of the planner, and the safe instances are those that it chooses from."""

import dataclasses
import re

import numpy as np
import pytest

from aero_planner import PlannerConfig, PlanStatus
from aero_viz.catalog import open_source
from aero_viz.errors import UserError
from aero_viz.explain.evidence import Replanner
from aero_viz.explain.terms import STAGE1, STAGE2
from aero_viz.explain.verdict import verdict
from aero_viz.flight.known_drone import config_for_flight
from aero_viz.session import Session
from tests.explain.conftest import evidence_of

FLIGHTS = (
    ("forest", 60, 15, "default"),
    ("double_wall_trap", 36, 12, "default"),
    ("verticals", 80, 20, "paper"),
    ("verticals", 40, 20, "px4"),
    ("double_wall_trap", 32, 16, "paper"),
)


@pytest.mark.parametrize("flight", FLIGHTS)
def test_terms_add_up_to_the_costs_of_the_planner(flight):
    for evidence in evidence_of(*flight):
        plan = evidence.frame.plan
        assert evidence.is_exact
        assert evidence.terms.shape == (len(STAGE2), *plan.controls.shape[:2])
        np.testing.assert_allclose(evidence.terms.sum(axis=(0, 2)), plan.stage2_cost, rtol=1e-5)
        np.testing.assert_allclose(evidence.terms[:4].sum(axis=(0, 2)), plan.goal_cost, rtol=1e-5)
        collision = evidence.terms[STAGE2.index("obstacles")].sum(axis=1)
        np.testing.assert_allclose(collision, plan.collision_cost, rtol=1e-4, atol=0.01)
        for instance in (0, len(plan.kinds) - 1):
            stage1, cost = evidence.stage1(instance), plan.stage1_cost[instance]
            assert len(stage1.terms) == len(STAGE1)
            np.testing.assert_allclose(stage1.terms.sum(axis=(0, 2)), cost, rtol=3e-4)
            assert stage1.best == cost.argmin() and 1.0 <= stage1.effective_samples <= len(cost)


@pytest.mark.parametrize("flight", FLIGHTS)
def test_the_planner_chooses_the_cheapest_safe_instance(flight):
    prefers_safe = flight[-1] != "paper"
    for evidence in evidence_of(*flight):
        plan, best = evidence.frame.plan, int(evidence.frame.plan.best)
        if plan.status == PlanStatus.OK:
            assert evidence.is_safe[best]
            assert best == np.where(evidence.is_safe | (not prefers_safe), plan.stage2_cost, np.inf).argmin()
        else:
            assert not evidence.is_safe[best]
            assert not (prefers_safe and evidence.is_safe.any())


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


@pytest.mark.parametrize("prove_stop", ["off", "required", "instead"])
def test_a_drone_that_is_far_above_a_lower_speed_limit_is_unsafe_for_its_speed_and_not_for_the_ground(prove_stop):
    config = PlannerConfig().replace({"candidates.prove_stop": prove_stop, "sampling.samples": 64})
    session, replanner = Session(open_source("forest", seed=3), config=config), Replanner()
    for _ in range(60):
        session.tick()
    session.configure({"vehicle.speed_limit": 0.5})
    evidence = replanner(session.tick())
    session.close()
    replanner.close()
    sentences = [verdict(evidence, int(m)) for m in np.flatnonzero(~evidence.is_safe)]
    speed = r"at [\d.]+ m/s, above the speed limit of 0\.5 m/s, no clearance counts as enough"
    assert any(re.search(rf"is unsafe: {speed}\.", sentence) for sentence in sentences), sentences
    assert not any("the ground" in sentence for sentence in sentences), sentences


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_a_frame_knows_the_safe_instances_without_an_explanation(replan, preset: str):
    source = open_source("double_wall_trap", seed=1)
    wide = PlannerConfig.preset(preset).replace({"candidates.safe_clearance": 0.5, "candidates.stop_clearance": 0.5})
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
