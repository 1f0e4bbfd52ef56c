"""Cameras that see the drone, whatever grows between them."""

import dataclasses
from collections.abc import Iterator

import numpy as np
import pytest

from aero_viz.dashboard.outlook import Outlook, Sight, has_hit_ground, turned
from aero_viz.dashboard.tour import Director
from aero_viz.flight import FlightSource
from aero_viz.scenes import World, scene
from aero_viz.session import Frame, Session

START, GOAL = np.array([0.0, 0.0, 2.0]), np.array([30.0, 0.0, 2.0])
BEHIND = np.array([-5.2, 0.0, 2.3])


def trunks(*places: tuple[float, float]) -> World:
    """Return a world with trunks of 0.6 m, 8 m high."""
    table = np.array([[x, y, 0.0, 0.0, 0.0, 1.0, 0.3, 8.0] for x, y in places]).reshape(-1, 8)
    return World("trunks", START, GOAL, cylinders=table)


@pytest.fixture(scope="module")
def first() -> Iterator[Frame]:
    session = Session(FlightSource(trunks((-3.0, 0.0))))
    yield session.tick()
    session.close()


def at(frame: Frame, world: World, time: float, x: float) -> Frame:
    """Return a frame in another world, at a time [s], with the drone at a place along the way to the goal [m]."""
    state = dataclasses.replace(
        frame.observation.actual_state,
        position=np.array([x, 0.0, 2.0], np.float32),
        velocity=np.array([4.0, 0.0, 0.0], np.float32),
    )
    observation = dataclasses.replace(frame.observation, state=state, true_state=state, world=world)
    return dataclasses.replace(frame, time=time, observation=observation)


def test_a_camera_behind_a_trunk_looks_past_it(first):
    sight = Sight()
    drone = first.drone_position
    assert sight.blocking(first, drone + BEHIND, drone) == 1
    offset = Outlook(sight)(first, BEHIND)
    assert sight.blocking(first, drone + offset, drone) == 0
    assert np.linalg.norm(offset) <= np.linalg.norm(BEHIND) + 1e-9 and offset[2] > 0.0


def test_a_camera_with_a_free_view_stays_where_its_visitor_wants_it(first):
    outlook = Outlook(Sight())
    for tick in range(100):
        frame = at(first, trunks((5.0, 3.0)), 0.02 * tick, 0.08 * tick)
        np.testing.assert_allclose(outlook(frame, BEHIND), BEHIND, atol=1e-9)


def test_a_camera_waits_turns_once_and_comes_back_without_swinging(first):
    # A row of trunks on the right, which hide the drone from behind on the right one after the other.
    world, sight = trunks(*[(3.0 * k, -1.0) for k in range(1, 7)]), Sight()
    wanted = np.array([-5.0, -1.6, 2.3])
    outlook, headings, hidden, plain = Outlook(sight), [], 0, 0
    for tick in range(700):
        frame = at(first, world, 0.02 * tick, 0.08 * tick)
        drone, offset = frame.drone_position, outlook(frame, wanted)
        headings.append(np.degrees(np.arctan2(-offset[1], -offset[0]) - np.arctan2(1.6, 5.0)))
        hidden += sight.blocking(frame, drone + offset, drone) > 0
        plain += sight.blocking(frame, drone + wanted, drone) > 0
    turns = np.diff(headings)
    assert np.abs(turns).max() < 4.0, "smooth"
    assert (np.diff(np.sign(turns[np.abs(turns) > 0.05])) != 0).sum() <= 1, "there and back"
    assert np.abs(headings).max() > 20.0 and abs(headings[-1]) < 1.0
    assert plain > 100 and hidden < 0.2 * plain


def test_time_may_jump_back_and_a_choice_of_the_visitor_is_taken_at_once(first):
    outlook = Outlook(Sight())
    world = trunks((-3.0, 0.0))
    for time in (5.0, 1.0, 1.02):
        outlook(at(first, world, time, 0.0), BEHIND)
    frame = at(first, world, 1.04, 0.0)
    outlook.take(frame)
    np.testing.assert_allclose(outlook(frame, BEHIND), BEHIND, atol=1e-9)


@pytest.mark.parametrize("elevation", [-70.0, 0.0, 60.0, 89.0])
def test_a_turn_keeps_the_distance_and_never_passes_the_zenith(elevation):
    up = np.radians(elevation)
    offset = 5.0 * np.array([-np.cos(up), 0.0, np.sin(up)])
    again = turned(offset, (np.radians(30.0), np.radians(42.0), 1.0))
    assert np.linalg.norm(again) == pytest.approx(5.0)
    assert again[2] >= offset[2] - 1e-9
    np.testing.assert_allclose(turned(offset, (0.0, 0.0, 1.0)), offset, atol=1e-12)


@pytest.mark.parametrize("name", ["forest", "inclines"])
def test_the_tour_looks_past_most_obstacles(name):
    session, sight = Session(FlightSource(scene(name, seed=1, count=300))), Sight()
    director, blind = Director(), Director()
    hidden: dict[Director, int] = {director: 0, blind: 0}
    for _ in range(200):
        frame = session.tick()
        empty = dataclasses.replace(frame.observation, world=World("empty", START, GOAL))
        for one, seen in ((director, frame), (blind, dataclasses.replace(frame, observation=empty))):
            hidden[one] += sight.blocking(frame, one(seen)[0], frame.drone_position) > 0
    session.close()
    assert hidden[blind] > 30 and hidden[director] < 0.6 * hidden[blind]


def test_a_crash_on_the_ground_is_told_from_one_in_a_trunk(first):
    ground = np.array([[0.0, 0.0, -0.5, 100.0, 100.0, 1.0, 0.0]])
    world = World("g", START, GOAL, cylinders=trunks((9.0, 0.0)).cylinders, boxes=ground)
    ended = dataclasses.replace(at(first, world, 1.0, 8.5), outcome="collision")
    assert not has_hit_ground(ended)
    low = dataclasses.replace(ended.observation.actual_state, position=np.array([4.0, 0.0, 0.1], np.float32))
    on_ground = dataclasses.replace(ended, observation=dataclasses.replace(ended.observation, true_state=low))
    assert has_hit_ground(on_ground)
    assert not has_hit_ground(dataclasses.replace(on_ground, outcome=None))
