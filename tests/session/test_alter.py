"""Changes of the world during a flight: what the planner sees, time travel, and refusals."""

import dataclasses
import gc
import weakref
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from aero_planner import PlanStatus
from aero_viz.errors import UserError
from aero_viz.flight import FlightSource
from aero_viz.scenes import World
from aero_viz.scenes.obstacles import ObstacleKey, with_obstacle
from aero_viz.session import Session
from aero_viz.session.repeat import repeat

WALL = [[6.0, 0.0, 2.0, 0.4, 3.0, 4.0, 0.0]]


@pytest.fixture
def session() -> Iterator[Any]:
    """An empty world with a ground, 0.3 s into the flight."""
    ground = [10.0, 0.0, -0.5, 60.0, 60.0, 1.0, 0.0]
    world = World.from_dict({"name": "empty", "start": [0, 0, 2], "goal": [20, 0, 2], "boxes": [ground]})
    session = Session(FlightSource(world, seed=1), seed=1)
    for _ in range(15):
        session.tick()
    yield session
    session.close()


def with_wall(source: Any) -> None:
    world = source.observe().world
    source.set_world(dataclasses.replace(world, boxes=np.vstack([world.boxes, WALL])))


def points_on_wall(frame: Any) -> int:
    points = frame.observation.points
    return int((np.abs(points - [5.8, 0.0, 2.0]) < [0.15, 1.6, 1.9]).all(axis=1).sum())


def test_an_added_obstacle_is_seen_and_is_gone_at_earlier_ticks(session):
    before, time = session.frame.world, session.frame.time
    session.alter(with_wall).result()
    assert session.frame.time == time and len(session.frame.world.boxes) == 2
    later = [session.tick() for _ in range(15)][-1]
    assert points_on_wall(later) > 200
    session.seek(0.1).result()
    assert session.frame.world is before and points_on_wall(session.frame) == 0
    session.seek(later.time).result()
    assert np.array_equal(session.frame.plan.command, later.plan.command)
    assert np.array_equal(session.frame.observation.points, later.observation.points)


def test_a_flight_with_another_world_and_wind_is_repeated_bit_for_bit(session):
    wind = {"drone.drag": 0.3, "drone.gust_speed": 3.0, "noise.position": 0.05}
    session.alter(lambda source: source.set_conditions(wind)).result()
    session.alter(with_wall).result()
    frames = [session.tick() for _ in range(12)]
    session.alter(lambda source: source.set_conditions({"lidar.dropout": 0.9})).result()
    frames += [session.tick() for _ in range(12)]
    for original in frames[::6]:
        session.seek(original.time).result()
        if original is not frames[11]:  # its plan was made once more after the last change
            assert np.array_equal(session.frame.plan.command, original.plan.command)
    session.seek(frames[-1].time).result()
    again = list(repeat(FlightSource.twin(session.source), session.flown().result(), device="cpu", seed=1))
    assert np.array_equal(again[-1].observation.points, frames[-1].observation.points)
    assert np.array_equal(again[-1].plan.command, frames[-1].plan.command)
    assert not np.array_equal(again[-1].observation.state.position, again[-1].observation.actual_state.position)


def test_lost_sweeps_age_the_cloud_until_the_drone_brakes_and_latency_delays_it(session):
    session.alter(lambda source: source.set_conditions({"lidar.sweep_loss": 1.0})).result()
    blind = [session.tick() for _ in range(60)]
    ages = [frame.observation.cloud_age for frame in blind]
    assert ages[0] == 0.0 and ages[-1] == pytest.approx(1.1) and np.all(np.diff(ages) >= 0.0)
    assert not len(list(blind[-1].observation.sweeps)[-1]) and blind[-1].plan.status == PlanStatus.STALE_CLOUD
    session.alter(lambda source: source.set_conditions({"lidar.sweep_loss": 0.0, "drone.latency": 0.2})).result()
    late = [session.tick() for _ in range(20)]
    assert late[-1].observation.cloud_age == 0.0
    for original in (blind[30], late[-1]):
        session.seek(original.time).result()
        assert np.array_equal(session.frame.observation.points, original.observation.points)
        assert np.array_equal(session.frame.plan.command, original.plan.command)
    source = FlightSource.twin(session.source)
    again = list(repeat(source, session.flown().result(), device="cpu", seed=1))
    assert np.array_equal(again[-1].observation.actual_state.position, late[-1].observation.actual_state.position)
    session.seek(0.1).result()
    assert session.frame.observation.conditions["drone.latency"] == 0.0


def test_changes_of_world_and_configuration_are_undone_in_reverse_order(session):
    before = session.frame.world
    session.alter(with_wall).result()
    walled = session.frame.world
    session.configure({"costs.q_track": 8.0})
    session.tick()
    session.undo()
    assert session.config.costs.q_track != 8.0 and session.frame.world is walled
    session.undo()
    assert session.frame.world is before and len(session.tick().world.boxes) == 1
    session.redo()
    assert session.frame.world is walled and session.config.costs.q_track != 8.0
    session.redo()
    assert session.config.costs.q_track == 8.0
    session.seek(0.1).result()  # before the wall
    session.undo()
    assert session.frame.world is before and session.config.costs.q_track != 8.0


def test_the_moves_of_a_drag_are_one_step_of_undo(session):
    before = session.frame.world
    for _ in range(3):
        session.alter(with_wall, step=session).result()
        session.tick()
    session.alter(with_wall).result()
    session.undo()
    assert len(session.frame.world.boxes) == 4
    session.undo()
    assert session.frame.world is before


def test_a_replaced_source_takes_the_worlds_of_its_changes_with_it(session):
    session.alter(with_wall).result()
    before = weakref.ref(session.frame.world)
    session.set_source(FlightSource(World("empty", np.array([0.0, 0.0, 2.0]), np.array([9.0, 0.0, 2.0])))).result()
    gc.collect()
    assert before() is None


def test_the_drone_can_be_moved_and_flies_on_from_there(session):
    session.alter(lambda source: source.set_position([3.0, 4.0, 2.0])).result()
    assert session.frame.observation.actual_state.position == pytest.approx([3.0, 4.0, 2.0])
    assert session.tick().observation.actual_state.position == pytest.approx([3.0, 4.0, 2.0], abs=0.2)
    session.seek(0.1).result()
    assert session.frame.observation.actual_state.position[1] == pytest.approx(0.0, abs=0.1)


@pytest.mark.parametrize(
    ("change", "error"),
    [
        (lambda source: source.set_position([3.0, 0.0, -0.5]), UserError),
        (lambda source: source.set_position([np.nan, 0.0, 2.0]), UserError),
        (lambda source: source.set_conditions({"noise.position": -1.0}), ValueError),
        (lambda source: source.set_conditions({"drone.mass": 2.0}), ValueError),
        (lambda source: source.set_conditions({"drone.latency": 2.0}), ValueError),
    ],
)
def test_a_change_that_cannot_be_is_refused_and_changes_nothing(session, change, error):
    frame = session.frame
    with pytest.raises(error):
        session.alter(change).result()
    assert session.frame.world is frame.world
    following = session.tick()
    session.seek(frame.time).result()
    assert np.array_equal(session.tick().plan.command, following.plan.command)


def test_a_frame_has_obstacles_where_they_are_and_edits_keep_the_others_moving():
    poles = np.array([[8.0, y, 0.0, 0.0, 0.0, 1.0, 0.3, 5.0] for y in (-6.0, 6.0)])
    motion = np.array([[0.0, -1.0, 4.0], [0.0, 1.0, 4.0]])
    world = World("", np.array([0.0, 0.0, 2.0]), np.array([20.0, 0.0, 2.0]), cylinders=poles, motion=motion)
    session = Session(FlightSource(world, seed=1), seed=1)
    frame: Any = [session.tick() for _ in range(6)][-1]
    assert frame.time == pytest.approx(0.1) and frame.moving_world is world
    np.testing.assert_allclose(frame.world.cylinders[:, 1], [-6.1, 6.1])
    assert frame.world is frame.world
    session.alter(lambda source: source.set_world(with_obstacle(world, None, ObstacleKey("cylinders", 0))))
    frame = session.tick()
    np.testing.assert_allclose(frame.world.cylinders[:, 1], [6.0 + frame.time])
    session.undo()
    frame = session.tick()
    assert frame.moving_world is world and len(frame.world.cylinders) == 2
    session.close()
