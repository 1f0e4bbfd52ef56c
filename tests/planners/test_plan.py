"""The minimal plan of any planner."""

from typing import Any

import numpy as np
import pytest

from aero_planner import PlanStatus
from aero_viz.planners import CandidatePlan
from aero_viz.planners.plan import EXTENSIONS, ensemble, lacks

TIMES = 0.1 * np.arange(6)
PATHS = np.stack([np.stack((k * TIMES**2, TIMES, 0.0 * TIMES), axis=1) for k in (1.0, 2.0)])
PLAN: dict[str, Any] = {"positions": PATHS, "costs": {"a": [1.0, 2.0], "b": [3.0, 1.0]}, "best": 1, "step": 0.1}


def test_a_minimal_plan_is_completed():
    plan = CandidatePlan(**PLAN)
    assert plan.cost.tolist() == [4.0, 3.0] and plan.kinds == ("path", "path") and plan.status == PlanStatus.OK
    # x = 2 t^2 along the chosen path.
    np.testing.assert_allclose(plan.command[:3], [[4.0, 0.0, 0.0, 0.0]] * 3, atol=1e-3)
    np.testing.assert_allclose(plan.velocities[1, 2], [4.0 * 0.2, 1.0, 0.0], atol=1e-4)
    assert plan.clearance.shape == (2, 5) and np.isnan(plan.clearance).all()
    half = 0.5 * np.arctan2(1.0, 0.8)
    np.testing.assert_allclose(plan.quaternions[1, 2], [np.cos(half), 0.0, 0.0, np.sin(half)], atol=1e-4)


def test_a_minimal_plan_says_what_it_lacks():
    plan = CandidatePlan(**PLAN)
    assert [lacks(plan, name) for name in EXTENSIONS] == [f"This planner has no {name}." for name in EXTENSIONS]
    assert lacks(plan, "cells", "guides") == "This planner has no cells, guides." and lacks(plan) == ""
    assert ensemble(plan) is None


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"positions": PATHS[0]}, r"positions has the shape \(6, 3\); it must be \(any, any, 3\)"),
        ({"positions": np.nan * PATHS}, "positions has numbers that are not finite"),
        ({"costs": {"a": [1.0]}}, r"costs\['a'\] has the shape \(1,\); it must be \(2\)"),
        ({"costs": {"a": [1.0, np.nan]}}, r"costs\['a'\] has numbers that are not finite"),
        ({"best": 2}, r"best is 2; it must be in \[0, 1\]"),
        ({"step": 0.0}, "step is 0.0; it must be a positive time"),
        ({"controls": [[1.0, 2.0]]}, r"controls has the shape \(1, 2\); it must be \(any, 4\)"),
        ({"controls": np.zeros((0, 4))}, "controls are empty"),
        ({"kinds": ("one",)}, "must have one entry for each of the 2 candidates"),
        ({"status": 7}, "7 is not a valid PlanStatus"),
    ],
)
def test_garbage_is_refused_with_its_name(changes: dict[str, Any], text: str):
    with pytest.raises(ValueError, match=text):
        CandidatePlan(**PLAN | changes)
