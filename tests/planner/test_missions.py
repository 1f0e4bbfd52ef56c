import json
import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from aero_planner.mission_progress import MissionProgress
from aero_planner.missions import Mission, Waypoint

TICK = 0.02


def mission(*texts: str) -> Mission:
    return Mission(tuple(map(Waypoint.parse, texts)))


def follow(
    progress: MissionProgress, places: Any, *, speed: float | None = None, start: float = 0.0, period: float = TICK
) -> tuple[MissionProgress, float]:
    """Return the progress of a drone that is at one place [m] per tick, and the time of the last one [s]."""
    time, last = start, None
    for place in np.asarray(places, dtype=float).tolist():
        moved = 0.0 if last is None else math.dist(last, place) / period
        progress = progress.advance(time, place, moved if speed is None else speed)
        time, last = time + period, place
    return progress, time - period


def line(a: Any, b: Any, *, speed: float, period: float = TICK) -> np.ndarray:
    count = max(1, round(math.dist(a, b) / (speed * period)))
    return np.linspace(a, b, count + 1)


def test_a_waypoint_is_passed_where_the_drone_is_nearest_to_it():
    progress, _ = follow(MissionProgress(mission("10,0,2", "20,5,2")), line((0, 0.4, 2), (9.9, 0.4, 2), speed=7.0))
    assert progress.index == 0  # within the radius, and still coming nearer
    progress, _ = follow(MissionProgress(mission("10,0,2", "20,5,2")), line((0, 0.4, 2), (10.3, 0.4, 2), speed=7.0))
    (event,) = progress.events
    assert (progress.index, event.waypoint, event.kind) == (1, 0, "passed")
    assert event.distance == pytest.approx(0.4, abs=0.01) and event.time == pytest.approx(10 / 7.0, abs=2 * TICK)
    assert event.text.startswith("Waypoint 1 of 2 at (10, 0, 2) was passed after 1.4")


def test_a_fast_drone_does_not_jump_past():
    steps = [(0, 0, 2), (4, 0, 2), (8, 0, 2), (12, 0, 2)]  # 4 m per tick, a radius of 0.3 m
    progress, _ = follow(MissionProgress(mission("10,0,2,radius=0.3", "20,0,2")), steps)
    assert [event.distance for event in progress.events] == [0.0]


def test_a_miss_does_not_count_and_the_goal_returns_to_the_waypoint():
    progress = MissionProgress(mission("10,0,2,radius=0.5", "20,5,2"))
    progress, _ = follow(progress, line((0, 0, 2), (7, 0.4, 2), speed=7.0))
    assert progress.beyond is not None
    progress, time = follow(progress, line((7, 0.4, 2), (12, 2, 2), speed=7.0), start=1.1)
    assert progress.events == () and progress.goal(time) == (10.0, 0.0, 2.0)
    progress, _ = follow(progress, line((12, 2, 2), (9.5, -0.2, 2), speed=7.0), start=time)
    assert progress.passed == 1


def test_the_goal_lies_beyond_a_waypoint_that_is_passed_but_not_beyond_one_to_stop_at():
    far, near = (0, 0, 2), (6, 0, 2)
    for text, expected in (("10,0,2", True), ("10,0,2,stop", False)):
        progress = MissionProgress(mission(text, "20,5,2"))
        progress, time = follow(progress, [far, far])
        assert progress.goal(time) == (10.0, 0.0, 2.0)
        progress, time = follow(progress, line(far, near, speed=7.0))
        goal = progress.goal(time)
        assert (goal[0] > 15.0) == expected and goal[1:] == (0.0, 2.0)
    last, time = follow(MissionProgress(mission("10,0,2")), line(far, near, speed=7.0))
    assert last.goal(time) == (10.0, 0.0, 2.0)


def test_a_stop_asks_for_rest_within_the_radius():
    progress, time = follow(MissionProgress(mission("10,0,2,stop", "20,0,2")), line((0, 0, 2), (10, 0, 2), speed=7.0))
    assert progress.index == 0
    progress, _ = follow(progress, [(10, 0, 2)] * 2, speed=0.4, start=time)
    assert [event.kind for event in progress.events] == ["stopped"]


def test_a_drone_stays_at_a_stop_for_the_time_to_hold_also_if_a_gust_moves_it():
    progress = MissionProgress(Mission((Waypoint((0, 0, 2), stop=True, hold=3.0), Waypoint((9, 0, 2)))))
    for time, x, speed in ((0.0, 0.2, 0.1), (1.0, 1.4, 0.9), (2.9, 0.2, 0.1)):
        progress = progress.advance(time, (x, 0.0, 2.0), speed)
        assert progress.index == 0
    paused = progress.paused(12.9, 10.0)  # the pilot had the drone meanwhile
    assert paused.advance(12.95, (0.2, 0.0, 2.0), 0.1).index == 0
    assert paused.advance(13.1, (0.2, 0.0, 2.0), 0.1).index == 1
    assert progress.advance(3.0, (0.2, 0.0, 2.0), 0.1).events[-1].kind == "stopped"


@pytest.mark.parametrize(("hold", "stop"), [(3.0, False), (-1.0, True), (601.0, True)])
def test_a_time_to_hold_is_bounded_and_needs_a_stop(hold: float, stop: bool):
    with pytest.raises(ValueError, match=r"hold is .*; it must be 0 to 600 s, and 0 without a stop"):
        Waypoint((0.0, 0.0, 2.0), stop=stop, hold=hold)


def test_a_passed_waypoint_is_never_flown_to_again():
    waypoints = mission("10,0,2", "0,0,2", "10,0,2", "5,0,2")
    path = np.concatenate(
        [line(a, b, speed=5.0)[1:] for a, b in pairwise([(0, 0, 2), (12, 0, 2), (-2, 0, 2), (12, 0, 2)])]
    )
    progress, goals = MissionProgress(waypoints), []
    for k, place in enumerate(path.tolist()):
        progress = progress.advance(k * TICK, place, 5.0)
        goals.append(progress.index)
    assert goals == sorted(goals) and [event.waypoint for event in progress.events] == [0, 1, 2]
    assert progress.is_last and not progress.is_over


def test_a_waypoint_is_given_up_after_its_time_without_coming_nearer():
    progress = MissionProgress(mission("10,0,2,timeout=2", "0,10,2"))
    progress, time = follow(progress, line((0, 0, 2), (6, 0, 2), speed=2.0))
    assert progress.events == ()
    wall = [(6.0, 0.1 * (-1) ** k, 2.0) for k in range(150)]
    blocked, _ = follow(progress, wall, start=time + TICK)
    (event,) = blocked.events
    assert (event.kind, event.waypoint, blocked.index, blocked.passed) == ("given_up", 0, 1, 0)
    assert event.time - time == pytest.approx(2.0, abs=0.3)  # it came nearer by half a metre up to a quarter second ago
    assert "was given up" in event.text and "not come nearer than 4.0 m within 2 s." in event.text


def test_the_time_counts_from_the_last_progress_not_from_the_beginning_of_the_leg():
    progress, time = follow(
        MissionProgress(mission("30,0,2,timeout=2", "0,10,2")), line((0, 0, 2), (29, 0, 2), speed=1.0)
    )
    assert time > 25.0 and progress.events == ()


def test_the_reason_names_what_is_in_the_way():
    def obstacle(place: Any, waypoint: Any) -> str:
        assert place == (6.0, 0.0, 2.0) and waypoint == (10.0, 0.0, 2.0)
        return "box 3 stands in between"

    progress = MissionProgress(mission("10,0,2,timeout=1", "0,10,2"))
    for k in range(60):
        progress = progress.advance(k * TICK, (6.0, 0.0, 2.0), 0.0, obstacle=obstacle)
    assert progress.events[0].text.endswith("within 1 s; box 3 stands in between.")


def test_a_stop_that_is_reached_but_never_at_rest_says_so():
    swinging = [(10.0, 0.3 * (-1) ** k, 2.0) for k in range(120)]
    progress, _ = follow(MissionProgress(mission("10,0,2,stop,timeout=2", "0,10,2")), swinging, speed=5.0)
    assert "the drone has not stopped there within 2 s" in progress.events[0].text


def test_the_last_waypoint_is_never_given_up_and_ends_the_mission():
    progress, time = follow(MissionProgress(mission("10,0,2,stop,timeout=1")), [(5, 0, 2)] * 200)
    assert progress.events == () and progress.is_last
    over, time = follow(progress, line((5, 0, 2), (10, 0, 2), speed=2.0), start=time)
    over, time = follow(over, [(10, 0, 2)] * 2, start=time, speed=0.0)
    assert over.is_over and over.passed == 1 and over.goal(time) == (10.0, 0.0, 2.0)
    assert over.advance(time + 1.0, (0, 0, 2), 1.0) is over
    arrived = progress.arrive(9.0, (9.5, 0, 2))
    assert arrived.is_over and arrived.events[0].distance == 0.5 and arrived.arrive(10.0, (10, 0, 2)) is arrived


def test_a_goal_moves_along_a_recorded_path_and_ends_where_it_ends():
    walk = Waypoint.from_dict({"path": [[100.0, 0, 0, 2], [102.0, 4, 0, 2], [104.0, 4, 2, 2]], "stop": True})
    assert (walk.position, walk.duration) == ((4.0, 2.0, 2.0), 4.0)
    progress = MissionProgress(Mission((Waypoint((-2, 0, 2)), walk, Waypoint((0, 0, 2)))))
    progress, time = follow(progress, line((-5, 0, 2), (-1.9, 0, 2), speed=3.0))
    assert progress.index == 1
    begin = progress.since
    for elapsed, expected in ((1.0, (2, 0, 2)), (2.0, (4, 0, 2)), (3.0, (4, 1, 2)), (9.0, (4, 2, 2))):
        assert progress.goal(begin + elapsed) == pytest.approx(expected)
    progress, time = follow(progress, line((-1.9, 0, 2), (4, 2, 2), speed=6.0), start=time)
    progress, time = follow(progress, [(4, 2, 2)] * 50, start=time, speed=0.0)
    assert progress.index == 1 and progress.is_moving(time)
    progress, time = follow(progress, [(4, 2, 2)] * 150, start=time, speed=0.0)
    assert progress.index == 2 and progress.events[1].time == pytest.approx(begin + 4.0, abs=2 * TICK)


def test_a_leg_along_a_path_is_not_given_up_while_the_goal_moves():
    fleeing = Waypoint.from_dict({"path": [[0, 0, 0, 2], [6, 60, 0, 2]], "timeout": 1.0})
    start = MissionProgress(Mission((fleeing, Waypoint((0, 0, 2)))))
    progress, _ = follow(start, line((0, 0, 2), (6, 0, 2), speed=1.0))
    assert progress.events == ()
    progress, _ = follow(progress, [(6, 0, 2)] * 60, start=6.02)
    assert progress.events[0].kind == "given_up"


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("10,0,2", {}),
        ("-10, 0.5, 2 ,radius=0.5,stop", {"radius": 0.5, "stop": True}),
        ("10,0,2,speed=3,timeout=20", {"speed": 3.0, "timeout": 20.0}),
        ("10,0,2,hold=5,stop", {"stop": True, "hold": 5.0}),
    ],
)
def test_a_text_gives_a_waypoint(text: str, values: dict[str, Any]):
    waypoint = Waypoint.parse(text)
    assert waypoint == Waypoint(tuple(map(float, text.split(",")[:3])), **values)  # type: ignore[arg-type]
    assert Waypoint.from_dict(waypoint.to_dict()) == waypoint and waypoint.to_dict().keys() == {"position", *values}


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("10,0", "no three coordinates"),
        ("10,0,high", "a coordinate is 'high'; it must be a number"),
        ("10,0,nan", "z of the position is nan; it must be a finite number"),
        ("10,0,1e9", "z of the position is 1e+09; it must be within 1e+08 m of the origin"),
        ("10,0,2,stops", "'stops' is unknown (did you mean 'stop'?)"),
        ("10,0,2,radius=0", "radius is 0; it must be greater than 0 and at most 100 m"),
        ("10,0,2,timeout=1e9", "timeout is 1e+09; it must be greater than 0 and at most 600 s"),
        ("10,0,2,speed=fast", "speed is 'fast'; it must be a number"),
        ("10,0,2,speed=500", "vehicle.speed_limit is 500.0; it must be a number in [0.2, 50] m/s"),
        ("10,0,2,speed=2,speed=3", "speed is given twice"),
        ("10,0,2,hold=5", "hold is 5; it must be 0 to 600 s, and 0 without a stop"),
    ],
)
def test_a_malformed_text_says_what_is_wrong(text: str, problem: str):
    with pytest.raises(ValueError, match=r"is not of the form X,Y,Z\[,radius=R\]") as refused:
        Waypoint.parse(text)
    assert problem in str(refused.value) and repr(text) in str(refused.value)


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ([], r"the mission has \[\]; it must have the key waypoints"),
        ({"waypoint": []}, "the mission has the keys waypoint; it must have the key waypoints and no other"),
        ({"waypoints": []}, "no waypoints; give at least one"),
        ({"waypoints": 3}, "waypoints is 3; it must be a list"),
        ({"waypoints": [[1, 2, 3]]}, r"waypoint 1: it is \[1, 2, 3\]; write the keys position, radius"),
        ({"waypoints": [{"position": [1, 2, 3]}, {"radius": 1}]}, "waypoint 2: the position is missing"),
        ({"waypoints": [{"position": [1, 2]}]}, r"waypoint 1: the position is \[1, 2\]; it must be the 3 numbers"),
        ({"waypoints": [{"position": "123"}]}, "waypoint 1: the position is '123'"),
        ({"waypoints": [{"position": [1, 2, "3"]}]}, "waypoint 1: z of the position is '3'"),
        ({"waypoints": [{"position": [1, 2, 3], "radios": 1}]}, r"unknown key 'radios' \(did you mean 'radius'\?\)"),
        ({"waypoints": [{"position": [1, 2, 3], "stop": 1}]}, "stop is 1; it must be true or false"),
        (
            {"waypoints": [{"path": [[0, 1, 2, 3], [0, 1, 2, 3]]}]},
            "time of row 2 of the path is 0; times must increase",
        ),
        ({"waypoints": [{"path": []}]}, r"the path is \[\]; it must be rows of t, x, y, z"),
        ({"waypoints": [{"path": [[0, 1, 2]]}]}, "row 1 of the path is"),
        ({"waypoints": [{"path": [[0, 1, 2, 3]], "position": [0, 0, 0]}]}, "with a path it must be its end, or absent"),
    ],
)
def test_a_malformed_mission_names_the_waypoint(content: Any, problem: str):
    with pytest.raises(ValueError, match=problem):
        Mission.from_dict(content)


def test_a_mission_is_written_and_read_again():
    content = {
        "waypoints": [{"position": [10.0, 0.0, 2.0], "speed": 3.0}, {"path": [[0.0, 1.0, 2.0, 3.0]], "stop": True}]
    }
    assert Mission.from_dict(content).to_dict() == content


def test_the_share_of_the_way_counts_all_legs():
    progress = MissionProgress(mission("10,0,2", "10,10,2"))
    assert progress.share((0, 0, 2), (5, 0, 2)) == pytest.approx(0.25)
    progress, _ = follow(progress, line((5, 0, 2), (10.1, 0, 2), speed=5.0))
    assert progress.share((0, 0, 2), (10, 5, 2)) == pytest.approx(0.75)
    assert progress.arrive(9.0, (10, 9, 2)).share((0, 0, 2), (10, 9, 2)) == 1.0


def test_the_progress_of_a_log_is_read_again():
    waypoints = mission("10,0,2", "20,0,2", "30,0,2")
    progress, _ = follow(MissionProgress(waypoints), line((0, 0, 2), (12, 0, 2), speed=7.0))
    again = MissionProgress.from_dict(waypoints, json.loads(json.dumps(progress.to_dict())))
    assert (again.index, again.since, again.events) == (progress.index, progress.since, progress.events)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"index": 4}, "has others than these"),
        ({"index": 1e400}, "damaged"),
        ({"since": None}, "damaged"),
        ({"since": math.nan}, "not finite"),
        ({"events": 3}, "damaged"),
        ({"events": [{"kind": "passed"}]}, "damaged"),
        ({"events": [{"kind": "lost"}]}, "unknown kind; known: passed, stopped, given_up"),
        ({"events": [{"kind": "passed", "time": 0, "distance": math.inf, "waypoint": 0, "text": ""}]}, "not finite"),
        ({"events": [{"kind": "passed", "time": 0, "distance": 0, "waypoint": 3, "text": ""}]}, "others than these"),
    ],
)
def test_a_damaged_progress_is_refused(changes: dict[str, Any], problem: str):
    content = {"index": 0, "since": 0.0, "events": [], **changes}
    with pytest.raises(ValueError, match=problem):
        MissionProgress.from_dict(mission("10,0,2", "20,0,2", "30,0,2"), content)


def test_length_and_time_of_a_mission():
    legs = Mission.from_dict(
        {
            "waypoints": [
                {"position": [3, 4, 2]},
                {"path": [[0, 3, 4, 2], [5, 3, 10, 2]]},
                {"position": [3, 10, 5], "speed": 1},
            ]
        }
    )
    assert legs.length((0, 0, 2)) == pytest.approx(5 + 6 + 3)
    assert legs.duration((0, 0, 2), 5.0) == pytest.approx(1 + 5 + 3)
    assert legs.goal == (3.0, 10.0, 5.0) and Mission.to_goal(np.array([1, 2, 3])).goal == (1.0, 2.0, 3.0)


def test_the_goal_beyond_a_waypoint_stays_in_line_with_it():
    progress = MissionProgress(mission("10,0,2", "20,5,2"))
    progress, time = follow(progress, line((0, 0, 2), (5.5, 0, 2), speed=7.0))
    first = progress.goal(time)
    progress, time = follow(progress, line((5.5, 0, 2), (6.5, 0.02, 2), speed=7.0), start=time)
    assert progress.goal(time) == first  # nearly in line: a goal that jumps costs the planner its memory
    progress, time = follow(progress, line((6.5, 0.02, 2), (7.5, 1.0, 2), speed=7.0), start=time)
    place, goal, waypoint = np.array([7.5, 1.0, 2.0]), np.array(progress.goal(time)), np.array([10.0, 0.0, 2.0])
    ahead = (goal - place) / np.linalg.norm(goal - place)
    assert np.linalg.norm(np.cross(ahead, waypoint - place)) < 0.4


def test_a_mission_is_changed_ahead_of_the_drone_only():
    progress, time = follow(MissionProgress(mission("2,0,2", "9,0,2", "20,0,2")), line((0, 0, 2), (4, 0, 2), speed=2.0))
    assert progress.index == 1
    same_leg = progress.changed(mission("2,0,2", "9,0,2", "12,4,2", "20,0,2"), time)
    assert (same_leg.since, same_leg.events, same_leg.nearest) == (progress.since, progress.events, progress.nearest)
    other = progress.changed(mission("2,0,2", "5,3,2"), time)
    assert (other.index, other.since, other.passed) == (1, time, 1) and other.goal(time) == (5.0, 3.0, 2.0)
    with pytest.raises(ValueError, match="behind the drone cannot be changed"):
        progress.changed(mission("3,0,2", "9,0,2"), time)
    with pytest.raises(ValueError, match="no waypoint ahead"):
        progress.changed(mission("2,0,2"), time)
