"""The choices of two configurations, by the weights of both."""

import pytest
from ensemble_plans import plan_of

from aero_viz.catalog import open_source
from aero_viz.explain.crossed_costs import crossed_costs
from aero_viz.session import Session


@pytest.mark.parametrize("changes", [{"costs.q_position": 9.0}, {"vehicle.speed_limit": 2.0, "sampling.samples": 64}])
def test_each_choice_costs_its_own_s2_by_its_own_weights_and_the_choice_of_a_configuration_is_cheaper_by_it(
    replan, changes
):
    session = Session(open_source("forest", seed=0))
    for _ in range(30):
        session.tick()
    session.pin().result()
    session.configure(changes)
    a, b = session.comparison.frame, session.frame
    assert a is not None and b is not None and a.config is not b.config
    costs = crossed_costs(replan, a, b)
    assert costs is not None
    for own, frame in ((costs.by_a[0], a), (costs.by_b[1], b)):
        plan = plan_of(frame)
        assert own.s2 == pytest.approx(plan.stage2_cost[plan.best], rel=1e-4)
        assert own.goal == pytest.approx(plan.goal_cost[plan.best], rel=1e-4)
        assert own.collision == pytest.approx(plan.collision_cost[plan.best], rel=1e-4, abs=1e-2)
    assert costs.by_a[1].s2 != pytest.approx(costs.by_b[1].s2, rel=1e-3), "one plan by two sets of weights"
    session.configure({"sampling.steps": 20})
    assert session.frame is not None and crossed_costs(replan, a, session.frame) is None
    session.close()
