"""Simulated flights of missions."""

import numpy as np
import pytest
from small_source import small_config, small_source

from aero_planner.missions import Mission, Waypoint
from aero_viz.errors import UserError
from aero_viz.flight import FlightBatch, FlightRules, FlightSource, fly
from aero_viz.flight.explanation import obstruction
from aero_viz.flight.serial import SerialFlights
from aero_viz.scenes import World
from aero_viz.sensors import LidarModel
from aero_viz.session import Session

LIDAR = LidarModel("sparse", points_per_sweep=2000)
GROUND = [10.0, 0.0, -0.5, 80.0, 60.0, 1.0, 0.0]
SHORT = FlightRules(time_limit=20.0)


def mission(*texts: str) -> Mission:
    return Mission(tuple(map(Waypoint.parse, texts)))


def field(*boxes: list[float], route: Mission) -> World:
    start = np.array([0.0, 0.0, 2.0])
    return World("field", start, np.array(route.goal), boxes=np.array([*boxes, GROUND]), mission=route)


def flown(world: World):
    """Return the result, the frames and the last progress of a flight."""
    source = FlightSource(world, lidar=LIDAR, rules=SHORT, seed=1)
    session = Session(source, config=small_config(), seed=1)
    try:
        frames = [session.tick()]
        while frames[-1].outcome is None:
            assert len(frames) < 2000
            frames.append(session.tick())
        progress = frames[-1].observation.mission
        assert progress is not None
        return source.result(), frames, progress
    finally:
        session.close()


def test_waypoints_are_passed_in_order_each_leg_at_its_speed():
    route = mission("8,4,2", "14,-3,2.5,speed=2.5", "16,2,2,stop", "10,2,2")
    result, frames, progress = flown(field(route=route))
    assert result.arrived and (result.waypoints, result.waypoints_passed) == (4, 4) and result.explanation is None
    assert [event.waypoint for event in progress.events] == [0, 1, 2, 3]
    assert [event.kind for event in progress.events] == ["passed", "passed", "stopped", "passed"]
    path = np.array([frame.drone_position for frame in frames])
    for waypoint in route.waypoints:
        assert np.linalg.norm(path - waypoint.position, axis=1).min() <= 1.0
    legs = [frame.observation.mission.index for frame in frames if frame.observation.mission is not None]
    assert legs == sorted(legs)
    speeds = np.linalg.norm([np.asarray(frame.observation.actual_state.velocity) for frame in frames], axis=1)
    first, second = (speeds[np.array(legs) == leg] for leg in (0, 1))
    assert first.max() > 4.0 and second[len(second) // 2 :].max() < 3.0
    limits = {frame.config.vehicle.speed_limit for frame in frames}
    assert limits == {2.5, 7.0} and {frame.base_config for frame in frames} == {small_config()}


def test_a_drone_does_not_brake_at_a_waypoint_that_it_passes():
    _, frames, progress = flown(field(route=mission("12,0,2", "24,1,2")))
    (passed, _) = progress.events
    index = next(i for i, frame in enumerate(frames) if frame.time >= passed.time)
    assert np.linalg.norm(np.asarray(frames[index].observation.actual_state.velocity)) > 5.0


def test_a_waypoint_in_an_obstacle_is_flown_around_or_given_up_with_a_reason():
    tower = [8.0, 0.0, 2.0, 3.0, 3.0, 6.0, 0.0]
    around, _, _ = flown(field(tower, route=mission("8,0,2,radius=3", "16,0,2")))
    assert around.arrived and around.waypoints_passed == 2
    result, _, progress = flown(field(tower, route=mission("8,0,2,radius=0.5,timeout=2", "16,0,2")))
    assert result.arrived and (result.waypoints, result.waypoints_passed) == (2, 1)
    assert progress.events[0].kind == "given_up" and result.explanation == progress.events[0].text
    assert "Waypoint 1 of 2 at (8, 0, 2) was given up" in str(result.explanation)
    assert str(result.explanation).endswith("it lies inside box 0.")


def test_a_waypoint_behind_a_wall_is_given_up_and_the_wall_is_named():
    closet = [[x, 0.0, 3.0, 0.2, 4.0, 6.0, 0.0] for x in (8.0, 12.0)]
    closet += [[10.0, y, 3.0, 4.2, 0.2, 6.0, 0.0] for y in (-2.0, 2.0)] + [[10.0, 0.0, 6.0, 4.2, 4.2, 0.2, 0.0]]
    result, _, progress = flown(field(*closet, route=mission("10,0,2,timeout=3", "0,8,2")))
    assert result.arrived and progress.events[0].kind == "given_up"
    assert "stands in between" in progress.events[0].text and "; box " in progress.events[0].text


def test_what_is_in_the_way_of_a_waypoint():
    world = field([5.0, 0.0, 2.0, 1.0, 1.0, 4.0, 0.0], route=mission("9,0,2"))
    assert obstruction(world, (0, 0, 2), (9, 0, 2), radius=0.25) == "box 0 stands in between"
    assert obstruction(world, (0, 0, 2), (5, 0, 2), radius=0.25) == "it lies inside box 0"
    assert obstruction(world, (0, 0, 2), (5, 0.6, 2), radius=0.25) == "it lies only 0.10 m from box 0"
    assert obstruction(world, (0, 0, 2), (9, 0, 0.1), radius=0.25) == "it lies only 0.10 m from the ground"
    assert obstruction(world, (0, 3, 2), (9, 3, 2), radius=0.25) is None


def test_a_goal_that_moves_is_followed():
    walk = [[t, 4.0 + 2.0 * t, 3.0 * np.sin(0.5 * t), 2.0] for t in np.arange(0.0, 6.1, 0.1)]
    route = Mission.from_dict({"waypoints": [{"path": np.array(walk).tolist()}]})
    result, frames, progress = flown(field(route=route))
    assert result.arrived and result.flight_time_s >= 6.0 and progress.is_over
    late = [frame for frame in frames if 4.0 < frame.time < 6.0]
    for frame in late:
        goal = np.array(route.waypoints[0].at(frame.time))
        np.testing.assert_allclose(np.asarray(frame.observation.goal.position), goal, atol=1e-9)
        assert np.linalg.norm(frame.drone_position - goal) < 3.0


def test_a_mission_of_one_stop_is_the_flight_to_that_goal():
    alone = small_source()
    world = alone.info.world
    assert world is not None
    as_mission = world.with_mission(Mission.to_goal(world.goal))
    results = [fly(w, config=small_config(), lidar=LIDAR, rules=SHORT, seed=1) for w in (world, as_mission)]
    assert results[0].arrived and results[0].waypoints is None
    plain = [{key: value for key, value in result.to_dict().items() if key != "plan_ms_median"} for result in results]
    assert plain[0] == plain[1]


def test_a_return_to_an_earlier_leg_repeats_it_bit_for_bit():
    source = FlightSource(field(route=mission("6,2,2,speed=3", "12,-2,2", "16,0,2")), lidar=LIDAR, rules=SHORT, seed=1)
    session = Session(source, config=small_config(), seed=1)
    try:
        frames = [session.tick() for _ in range(200)]
        indices = [frame.observation.mission.index for frame in frames if frame.observation.mission is not None]
        assert indices[20] == 0 and indices[-1] > 0
        session.seek(frames[20].time).result()
        again = [session.tick() for _ in range(179)]
    finally:
        session.close()
    for before, after in zip(frames[21:], again, strict=True):
        np.testing.assert_array_equal(before.drone_position, after.drone_position)
        assert before.observation.mission == after.observation.mission and before.config == after.config


def test_the_mission_changes_during_the_flight():
    source = small_source(goal=30.0)
    session = Session(source, config=small_config(), seed=1)
    try:
        for _ in range(20):
            session.tick()
        source.set_mission(mission("4,6,2", "8,6,2"))
        np.testing.assert_array_equal(source.observe().goal.position, [4.0, 6.0, 2.0])
        frames = [session.tick() for _ in range(400)]
        assert frames[-1].outcome == "arrived" and source.result().waypoints_passed == 2
        source.set_goal([0.0, 6.0, 2.0])
        assert source.outcome is None and source.result().waypoints is None
    finally:
        session.close()


def test_a_drone_that_is_put_elsewhere_has_passed_nothing_on_the_way():
    source = FlightSource(field(route=mission("6,0,2", "20,0,2")), lidar=LIDAR, rules=SHORT, seed=1)
    session = Session(source, config=small_config(), seed=1)
    try:
        session.tick()
        source.set_position([12.0, 0.0, 2.0])
        session.tick()
        progress = source.observe().mission
        assert progress is not None and progress.events == () and progress.index == 0
    finally:
        session.close()


def test_missions_that_no_drone_can_fly_are_refused():
    far = field(route=mission("5,0,2", "9,0,2"))
    outside = World(far.name, far.start, far.goal, bounds=far.bounds, mission=mission("5,0,200", "9,0,2"))
    with pytest.raises(
        UserError, match=r"Waypoint 1 of 2, \(5, 0, 200\), lies outside the bounds .*give another waypoint"
    ):
        fly(outside, config=small_config())
    slow = field(route=mission("9,0,2,speed=0.2", "30,0,2,speed=0.2"))
    with pytest.raises(UserError, match=r"The goal \(30, 0, 2\) .* is 21 m away and cannot be reached at 0\.2 m/s"):
        fly(slow, config=small_config())
    source = FlightSource(far, lidar=LIDAR)
    with pytest.raises(UserError, match="The mission stays as it was"):
        source.set_mission(mission("5,0,200", "9,0,2"))
    np.testing.assert_array_equal(source.observe().goal.position, [5.0, 0.0, 2.0])


def test_each_leg_has_the_time_limit():
    world = field(route=mission("12,0,2", "24,0,2"))
    result = fly(world, config=small_config(), lidar=LIDAR, rules=FlightRules(time_limit=0.5))
    assert (result.reason, result.flight_time_s, result.waypoints_passed) == ("timeout", 0.5, 0)


def test_a_batch_refuses_missions_and_serial_flights_fly_them():
    world = field(route=mission("3,1,2", "6,0,2"))
    with pytest.raises(ValueError, match="'field' has a mission, which a batch cannot fly; use SerialFlights"):
        FlightBatch([world])
    flights = SerialFlights([world], configs=[small_config()], seeds=[1], options={"lidar": LIDAR, "rules": SHORT})
    (result,) = flights.run()
    assert result.arrived and result.waypoints_passed == 2
