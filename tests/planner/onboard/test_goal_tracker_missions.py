"""Missions of the node: given by its settings or received, checked against the fence, and followed."""

from pathlib import Path

import numpy as np
import pytest

from aero_planner.missions import Mission, Waypoint
from aero_planner.onboard.goal_tracker import GoalTracker
from aero_planner.onboard.mission_offer import MissionOffer, first_goal
from aero_planner.onboard.settings import LimitSettings, OnboardConfig

LIMITS = LimitSettings(fence_radius=20.0)
MISSION = Mission((Waypoint((10.0, 0.0, 3.0), speed=2.0), Waypoint((18.0, 0.0, 3.0), stop=True)))


def take(goals: GoalTracker, mission: Mission | None, **options: object) -> str | None:
    offer = MissionOffer(mission)
    goals.update(None, offer, **options)  # type: ignore[arg-type]
    return offer.answer


def fly(goals: GoalTracker, first: float, last: float) -> None:
    for x in np.arange(first, last, 0.5):
        goals.advance(100.0 + x, (x, 0.0, 3.0), 5.0, flying=True)


def test_a_mission_is_followed_to_its_end():
    goals = GoalTracker(LIMITS, MISSION)
    goals.advance(100.0, (0.0, 0.0, 3.0), 0.0, flying=False)
    np.testing.assert_array_equal(goals.goal, [10.0, 0.0, 3.0])
    assert goals.speed_limit == 2.0 and goals.distance((10.0, 0.0, 3.0)) == np.inf, "it does not end at the first one"
    fly(goals, 0.0, 12.0)
    assert goals.progress is not None and [event.kind for event in goals.progress.events] == ["passed"]
    assert goals.speed_limit is None and goals.distance((17.0, 0.0, 3.0)) == pytest.approx(1.0)
    event = goals.advance(120.0, (17.8, 0.0, 3.0), 1.0, flying=True)
    assert event is not None and event.kind == "stopped" and goals.progress.is_over


def test_no_time_of_a_mission_passes_while_the_drone_does_not_fly():
    goals = GoalTracker(LIMITS, MISSION)
    for time in (100.0, 500.0):
        assert goals.advance(time, (0.0, 0.0, 3.0), 0.0, flying=False) is None
    assert goals.advance(501.0, (0.0, 0.0, 3.0), 0.0, flying=True) is None
    given_up = goals.advance(512.0, (0.0, 0.0, 3.0), 0.0, flying=True)
    assert given_up is not None and given_up.kind == "given_up"


def test_a_goal_behind_a_waypoint_at_the_fence_stays_inside():
    mission = Mission((Waypoint((19.9, 0.0, 3.0)), Waypoint((0.0, 0.0, 3.0), stop=True)))
    goals = GoalTracker(LIMITS, mission)
    fly(goals, 0.0, 19.0)
    assert goals.progress is not None and goals.progress.beyond is not None
    np.testing.assert_array_equal(goals.goal, [19.9, 0.0, 3.0])


def test_a_goal_replaces_a_mission_and_the_other_way_round():
    goals, sent = GoalTracker(LIMITS, MISSION), np.array([5.0, 0.0, 3.0])
    goals.update(sent)
    assert goals.progress is None and goals.count == 1
    assert take(goals, MISSION) == "" and goals.progress is not None and goals.count == 2
    goals.update(sent.copy())
    assert goals.progress is None and goals.count == 3, "the same goal again is a new one after a mission"


def test_a_refused_mission_leaves_the_present_one(caplog: pytest.LogCaptureFixture):
    goals = GoalTracker(LIMITS, MISSION)
    outside = Mission((*MISSION.waypoints, Waypoint((21.0, 0.0, 3.0))))
    assert take(goals, outside) == "waypoint 3 [21.0, 0.0, 3.0] lies outside the geofence"
    assert take(goals, Mission.to_goal((1.0, 0.0, 3.0)), refusal="the drone is braking") == "the drone is braking"
    assert goals.progress is not None and goals.progress.mission is MISSION and goals.count == 0
    assert "the mission is refused: waypoint 3" in caplog.text
    high = Mission.to_goal((1.0, 0.0, 31.0))
    assert "at 31.00 instead of 1 to 30 m above the local origin" in (take(goals, high) or "")


def test_a_cleared_mission_stops_a_drone_that_flies():
    goals = GoalTracker(LIMITS, MISSION)
    assert take(goals, None, place=(4.0, 0.0, 3.0)) == "" and goals.progress is None
    np.testing.assert_array_equal(goals.goal, [4.0, 0.0, 3.0])
    goals = GoalTracker(LIMITS, MISSION)
    assert take(goals, None) == "" and goals.goal is None


def test_a_mission_is_dropped_when_the_ground_turns_out_to_be_above_it(caplog: pytest.LogCaptureFixture):
    goals = GoalTracker(LIMITS, MISSION)
    goals.update(None, ground=2.5)
    assert goals.goal is None and goals.progress is None
    assert "waypoint 1 [10.0, 0.0, 3.0] is refused" in caplog.text and "correct mission.file" in caplog.text


def test_the_mission_of_the_settings(tmp_path: Path):
    file = tmp_path / "mission.yaml"
    file.write_text("waypoints:\n- {position: [10, 0, 3], speed: 2}\n- {position: [18, 0, 3], stop: true}\n")
    onboard = OnboardConfig().replace({"mission.file": str(file)})
    assert first_goal(onboard, None) == MISSION
    assert first_goal(OnboardConfig(), (1.0, 2.0, 3.0)) == (1.0, 2.0, 3.0)
    with pytest.raises(ValueError, match=r"--goal and mission.file \(.*\) both say where to fly; give one"):
        first_goal(onboard, (1.0, 2.0, 3.0))
    file.write_text("waypoints:\n- {position: [10, 0, 3], sped: 2}\n")
    with pytest.raises(ValueError, match=r"mission.yaml: waypoint 1: unknown key 'sped' .did you mean"):
        first_goal(onboard, None)
    with pytest.raises(ValueError, match=r"waypoint 2 \[18.0, 0.0, 3.0\] lies outside the geofence"):
        GoalTracker(LimitSettings(fence_radius=15.0), MISSION)
