"""The effects of small changes on one plan are those of the session that makes them."""

import pytest
from small_source import wait_for
from straight import StraightConfig

from aero_planner import PlannerConfig
from aero_viz.catalog import open_source
from aero_viz.errors import UserError
from aero_viz.explain.evidence import Replanner
from aero_viz.explain.sensitivity import sensitivity
from aero_viz.session import Session

CONFIG = PlannerConfig().replace({"sampling.samples": 16, "partition.fine_cells": 6})


@pytest.fixture(scope="module")
def session():
    session = Session(open_source("forest", seed=0), config=CONFIG)
    for _ in range(60):
        session.tick()
    session.start(play=False)
    session.step(1).result()
    yield session
    session.close()


def test_the_strongest_effects_come_first_and_are_those_of_the_session(session):
    replan, frame, counts = Replanner(), session.frame, []
    found = sensitivity(replan, frame, progress=lambda done, total: counts.append((done, total)) is None)
    replan.close()
    assert found is not None and counts[-1][0] == counts[-1][1] - 1 == 2 * len(found) - 1
    assert [one.rank for one in found] == sorted((one.rank for one in found), reverse=True)
    assert found[0].is_visible and not found[-1].is_visible
    visible = [effect for one in found if one.is_visible for effect in (one.less, one.more) if effect is not None]
    assert any(effect.is_other for effect in visible) or any(effect.clearance for effect in visible)
    base = frame.plan.clearance[frame.plan.best].min()
    for one in (found[0], found[1], found[-1]):
        for effect in filter(None, (one.less, one.more)):
            config = session.configure(CONFIG.replace({one.info.path: effect.value}))
            wait_for(lambda: session.frame.config == config)  # noqa: B023
            plan = session.frame.plan
            assert effect.choice == f"{plan.best} {plan.kinds[plan.best]}"
            assert effect.is_other == (plan.best != frame.plan.best)
            assert effect.clearance == pytest.approx(float(plan.clearance[plan.best].min() - base), abs=1e-6)
    session.configure(CONFIG)


def test_it_stops_when_it_is_told_to(session):
    replan = Replanner()
    assert sensitivity(replan, session.frame, progress=lambda done, _: done < 3) is None
    replan.close()


def test_another_planner_says_what_is_missing():
    session = Session(open_source("forest", seed=0), config=StraightConfig())
    frame = session.tick()
    with pytest.raises(UserError, match="AERO-MPPI alone"):
        sensitivity(Replanner(), frame, progress=lambda *_: True)
    session.close()
