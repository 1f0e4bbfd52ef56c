"""Bars and cards show the numbers of the planner."""

import dataclasses
import re
from html import unescape

import numpy as np
import pytest

from aero_planner import PlannerConfig
from aero_planner.cost_terms import CostTerms
from aero_planner.costs import CostTerm
from aero_viz.cost_text import cost_text
from aero_viz.dashboard.panels.why_card import card, chart
from aero_viz.explain.evidence import Evidence, Replanner
from aero_viz.flight import FlightSource, VehicleModel
from aero_viz.scenes import scene
from aero_viz.session import Session


@pytest.fixture(scope="module")
def evidence() -> Evidence:
    """The evidence of a plan against drag and gusts."""
    vehicle = VehicleModel(drag=0.3, gust_speed=4.0)
    config = PlannerConfig().replace({"sampling.samples": 32})
    session = Session(FlightSource(scene("forest", seed=3), vehicle=vehicle, seed=3), config=config, seed=3)
    frames = [session.tick() for _ in range(60)]
    session.close()
    replan = Replanner()
    evidence = replan(frames[-1])
    replan.close()
    assert isinstance(evidence, Evidence) and evidence.plan.disturbance is not None
    assert np.linalg.norm(evidence.plan.disturbance) > 0.1
    return evidence


def table(page: str) -> dict[str, list[str]]:
    """Return S1 and S2 by label, as the card shows them."""
    (content,) = re.findall(r'class="aero-term-table".*?</div></div>', page)
    cells = [re.sub("<[^>]*>", "", cell) for cell in re.findall(r"<div>(.*?)</div>", content)]
    rows = [cells[i : i + 3] for i in range(3, len(cells), 3)]
    return {label: numbers for label, *numbers in rows}


def with_term(evidence: Evidence, value: float) -> Evidence:
    """Return the evidence with another term of S2, which costs `value` per instance number and step."""
    costs, (n, _, N) = evidence.stage2, evidence.stage2.values.shape
    brought = np.broadcast_to(value * np.arange(n, dtype=np.float32)[:, None, None], (n, 1, N))
    values = np.concatenate((costs.values, brought), axis=1)
    terms = (*costs.terms, CostTerm("detour", "a detour <b>"))
    return dataclasses.replace(evidence, stage2=CostTerms(terms, values, costs.positions, costs.clearance))


def test_the_card_adds_up_to_the_costs_of_the_planner(evidence):
    plan = evidence.plan
    for m in range(len(plan.kinds)):
        rows = table(card(evidence, m))
        first, second = (float(text) for text in rows.pop("all"))
        assert first == pytest.approx(plan.stage1_cost[m].min(), rel=1e-3)
        assert second == pytest.approx(plan.stage2_cost[m], rel=1e-3)
        for column, total in enumerate((first, second)):
            numbers = [float(numbers[column]) for numbers in rows.values() if numbers[column]]
            assert sum(numbers) == pytest.approx(total, rel=2e-3, abs=0.5)


def test_the_rows_are_the_terms_in_their_order(evidence):
    labels = [term.label for term in (*evidence.stage1.terms, *evidence.stage2.terms)]
    rows = list(table(card(evidence, 0)))[:-1]
    assert rows == [label for label in dict.fromkeys(labels) if label in rows]
    assert {"guide tracking", "goal position"} <= set(rows)
    assert table(card(evidence, 0))["guide tracking"][1] == "", "S2 has no such term"


def test_the_columns_are_as_high_as_the_costs_differ(evidence):
    page, plan = chart(evidence, None), evidence.plan
    titles = [unescape(title) for title in re.findall(r'data-instance="\d+" title="([^"]*)"', page)]
    assert len(titles) == len(plan.kinds)
    for m, title in enumerate(titles):
        assert title.startswith(f"{m} {plan.kinds[m]}: S2 {cost_text(plan.stage2_cost[m])}")
        terms = [float(value) for value in re.findall(r" ([-\d.e+]+)(?:,|$)", title.partition(", ")[2])]
        assert sum(terms) == pytest.approx(plan.stage2_cost[m], rel=2e-3, abs=0.5)


def test_a_term_that_somebody_brings_has_its_bar_and_its_row(evidence):
    more = with_term(evidence, 1e3)
    assert "a detour &lt;b&gt;" in chart(more, None) and "a detour" not in chart(evidence, None)
    N = evidence.stage2.values.shape[2]
    assert table(card(more, 2))["a detour &lt;b&gt;"] == ["", cost_text(2e3 * N)]


def test_controls_have_the_names_and_bounds_of_the_model(evidence):
    page = card(evidence, 0)
    assert "F_t [N] in 0.3 .. 16.35" in page and "omega_z [rad/s] in -2 .. 2" in page
    other = evidence.frame.config.replace({"vehicle.model": "acceleration"})
    page = card(dataclasses.replace(evidence, frame=dataclasses.replace(evidence.frame, config=other)), 0)
    assert "a_x [m/s^2]<" in page and "yaw_rate [rad/s] in -2 .. 2" in page
