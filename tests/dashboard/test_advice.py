"""What is offered against a failure can be applied, and changes something."""

import pytest
from straight import StraightConfig

from aero_planner import PlannerConfig
from aero_viz.dashboard.advice import MOST, against

CAUSES = (
    "not seen: outside the field of view", "seen too late: occluded", "not seen: forgotten", "not seen: beyond range",
    "seen too late: no ray hit it", "seen, stopped too late", "seen, flown into with a plan that counted as safe",
    "hit a moving obstacle: seen, stopped too late", "stalled: no candidate was safe",
    "stalled: the cheapest candidate was not safe", "stalled: the cloud was stale", "stalled: every anchor is blocked",
    "stalled: the way to the goal is blocked", "stalled: moving without coming nearer",
    "out of time: coming nearer to the goal at 1.0 m/s", "left the world: moving without coming nearer",
)  # fmt: skip
"""Causes of `aero_viz.explain.post_mortem`."""


@pytest.mark.parametrize("preset", ["default", "paper"])
@pytest.mark.parametrize("cause", CAUSES)
def test_against_every_cause_there_are_changes_that_the_planner_takes(cause: str, preset: str):
    config = PlannerConfig.preset(preset)
    found = against(cause, config)
    assert 2 <= len(found) <= MOST
    for advice in found:
        assert config.replace({advice.path: advice.value}).differences(config).keys() == {advice.path}
        assert advice.text(config)


def test_a_change_goes_to_the_default_if_that_is_farther_and_switches_on_what_is_not_compiled_in():
    found = against("not seen: outside the field of view", PlannerConfig.preset("paper"))
    assert [advice.text(PlannerConfig.preset("paper")) for advice in found] == [
        "Switch on unseen space", "Speed limit [m/s]: 50 → 7", "Safe clearance [m]: 0.25 → 0.325",
    ]  # fmt: skip
    assert found[0].value == "unseen_space"


def test_nothing_helps_a_start_inside_an_obstacle_and_nothing_is_known_of_other_planners():
    assert against("start inside an obstacle", PlannerConfig()) == []
    assert against("stalled: no candidate was safe", StraightConfig()) == []
