"""What a user adds from outside has all that the planner's own parts have."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"

PLANS = """
import json
import numpy as np
import own_cost_term  # before anything imports the configuration
from aero_planner import Goal, Planner, PlannerConfig, VehicleState

state = VehicleState((0.0, 0.0, 2.0), (2.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
found = {}
for weight in (0.0, 50.0):
    config = PlannerConfig().replace({"height.q_height": weight, "sampling.samples": 16})
    planner = Planner(config, threads=1)
    plan = planner.plan(state, Goal((20.0, 0.0, 2.0)), np.full((1, 3), 9.0), samples=True)
    terms = planner.cost_terms([int(plan.best)], [(3, 5), (7, 0)])
    row = [term.name for term in terms.terms].index("height")
    heights = np.concatenate((plan.positions[plan.best, None, 1:], plan.samples[[3, 7], [5, 0], 1:]))[..., 2]
    found[weight] = {
        "labels": [term.label for term in terms.terms],
        "term": terms.values[:, row].tolist(),
        "expected": (weight * np.abs(heights - 1.0)).tolist(),
        "S1": [plan.stage1_cost[[3, 7], [5, 0]].tolist(), terms.stage1_cost[1:].tolist()],
        "S2": [float(plan.stage2_cost[plan.best]), float(terms.stage2_cost[0])],
        "weights": plan.controls[3].tolist(),
        "end": float(plan.positions[plan.best, -1, 2]),
    }
print(json.dumps(found))
"""


def run(*arguments: str) -> str:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(EXAMPLES), os.environ.get("PYTHONPATH", "")])}
    result = subprocess.run([sys.executable, *arguments], env=environment, capture_output=True, text=True, timeout=600)
    assert result.returncode == 0, result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def plans() -> dict[str, Any]:
    return json.loads(run("-c", PLANS).splitlines()[-1])


def test_a_cost_term_of_a_user_is_a_part_of_both_sums(plans: dict[str, Any]):
    for plan in plans.values():
        assert "height to keep" in plan["labels"]
        assert plan["term"] == [pytest.approx(row, rel=1e-4, abs=1e-4) for row in plan["expected"]]
        for actual, by_terms in (plan["S1"], plan["S2"]):
            assert by_terms == pytest.approx(actual, rel=1e-5)


def test_stage_1_optimises_the_cost_term_of_a_user(plans: dict[str, Any]):
    without, with_term = plans["0.0"], plans["50.0"]
    assert with_term["S1"][0][0] > without["S1"][0][0] + 100.0, "the same sample of the same noise costs more"
    assert with_term["weights"] != without["weights"], "instance 3 averages its samples by other weights"
    assert abs(with_term["end"] - 1.0) < abs(without["end"] - 1.0)


def test_the_parameters_of_a_user_have_flags_and_are_listed():
    script = str(EXAMPLES / "own_cost_term.py")
    assert "| `height.q_height` | Height weight |" in run(script, "parameters")
    short = ("fly", "pillars", "--rules.time-limit", "0.1", "--sampling.samples", "8", "--json")
    assert json.loads(run(script, *short, "--height.q-height", "40"))["config"] == "default, changed"
