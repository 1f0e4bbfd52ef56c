"""A stream as a source: placed sweeps, states, goals, garbage, and clocks that are set."""

from __future__ import annotations

import struct
from dataclasses import replace

import numpy as np
import pytest

from aero_planner.onboard.ros_definitions import GOAL
from aero_planner.onboard.ros_messages import goal_message, pose_messages
from aero_planner.plan import Goal, VehicleState
from aero_viz.errors import UserError
from aero_viz.live.setup import Wanted, find_setup
from aero_viz.live.source import StreamSource
from aero_viz.live.stream import Stream
from aero_viz.recordings.point_cloud2 import POINT_CLOUD2, encode_point_cloud2
from tests.live.conftest import Corridor, walls


def source_of(corridor: Corridor, **options: object) -> StreamSource:
    return StreamSource(corridor.stream, find_setup(corridor.stream, Wanted()), **options)  # type: ignore[arg-type]


def test_sweeps_are_placed_where_the_walls_are(corridor: Corridor):
    observation = source_of(corridor).observe()
    assert len(observation.sweeps) == 10
    for sweep in observation.sweeps:
        np.testing.assert_allclose(sweep, walls(), atol=2e-3)
    assert np.asarray(observation.state.velocity) == pytest.approx([1.0, 0.0, 0.0])


def test_the_newest_messages_are_used_and_earlier_ticks_can_be_returned_to(corridor: Corridor):
    source = source_of(corridor)
    first = source.checkpoint()
    corridor.fly(0.5)
    source.advance()
    assert source.observe().time > first.time
    assert not set(map(id, source.observe().sweeps)) <= set(map(id, first.sweeps))
    source.restore(first)
    assert source.observe().sweeps is first.sweeps
    source.advance()
    assert source.tick is source.newest


@pytest.mark.parametrize(
    ("points", "ahead", "reason"),
    [
        (np.full((100, 3), np.nan, np.float32), 0, "none of its points is valid"),
        (np.zeros((0, 3), np.float32), 0, "it has no points"),
        (None, 3_600_000_000_000, "its stamp is in the future"),
        (None, -3_600_000_000_000, "its stamp steps back"),
    ],
)
def test_garbage_is_left_out_counted_and_named(corridor: Corridor, points: np.ndarray | None, ahead: int, reason: str):
    source = source_of(corridor)
    corridor.cloud(points, ahead=ahead)
    corridor.fly(0.4)
    source.advance()
    assert corridor.stream.topics["/points"].unused == {reason: 1}
    assert reason in (source.explanation or "")
    for sweep in source.observe().sweeps:
        np.testing.assert_allclose(sweep, walls(), atol=2e-3)


def test_bytes_that_are_no_cloud_are_counted(corridor: Corridor):
    source = source_of(corridor)
    corridor.stream.add("/points", "sensor_msgs/msg/PointCloud2", b"\0\1\0\0" + bytes(40))
    corridor.stream.add("/odometry", "nav_msgs/msg/Odometry", b"\0\1")
    source.advance()
    assert sum(corridor.stream.topics["/points"].unused.values()) == 1
    assert sum(corridor.stream.topics["/odometry"].unused.values()) == 1


def test_a_driver_that_returns_with_another_type_is_said(corridor: Corridor):
    source = source_of(corridor)
    corridor.stream.add("/points", "livox_ros_driver2/msg/CustomMsg", bytes(100))
    source.advance()
    assert "it is livox_ros_driver2/msg/CustomMsg now: start aero-viz live again" in (source.explanation or "")


def test_reasons_that_differ_in_numbers_count_as_one(corridor: Corridor):
    source = source_of(corridor)
    for count in (1000, 1001, 1002):
        whole = encode_point_cloud2(walls(count), corridor.now, "body")
        corridor.stream.add(
            "/points", POINT_CLOUD2, whole.replace(struct.pack("<II", 1, count), struct.pack("<II", 2, count))
        )
    source.advance()
    (reason,) = corridor.stream.topics["/points"].unused
    assert "2 x 1000 points" in reason and f"3 of 23 messages on /points are left out because {reason}" in str(
        source.explanation
    )


@pytest.mark.parametrize("place", [(1e9, 0.0, 1.0), (np.nan, 0.0, 1.0)])
def test_a_goal_or_a_pose_that_the_planner_cannot_take_is_left_out(corridor: Corridor, place: tuple[float, ...]):
    source = source_of(corridor, goal_topic="/goal_pose", goal=(5.0, 0.0, 1.0))
    corridor.stream.add("/goal_pose", GOAL, goal_message(Goal(place), 1).data)
    far = VehicleState(np.nan_to_num(place, nan=np.inf), np.zeros(3), (1.0, 0.0, 0.0, 0.0))
    odometry, _ = pose_messages(far, corridor.now)
    corridor.stream.add("/odometry", odometry.kind, odometry.data, time=corridor.now)
    source.advance()
    assert np.asarray(source.observe().goal.position) == pytest.approx([5.0, 0.0, 1.0])
    assert np.asarray(source.observe().state.position)[0] < 3.0
    for topic in ("/goal_pose", "/odometry"):
        assert list(corridor.stream.topics[topic].unused.values()) == [1]


def test_a_clock_that_is_set_back_starts_over(corridor: Corridor):
    source = source_of(corridor)
    before = source.observe().time
    corridor.offset = -100_000_000_000
    corridor.fly(4.0)
    source.advance()
    assert source.observe().time > before  # the time of the source goes on
    np.testing.assert_allclose(source.observe().sweeps.newest, walls(), atol=2e-3)
    assert source.observe().cloud_age < 0.5


def test_the_goal_is_ahead_until_one_is_given(corridor: Corridor):
    source = source_of(corridor, goal_topic="/goal_pose")
    position = np.asarray(source.observe().state.position)
    assert np.asarray(source.observe().goal.position) - position == pytest.approx([15.0, 0.0, 0.0])
    source.set_goal((3.0, 1.0, 2.0))
    source.advance()
    assert np.asarray(source.observe().goal.position) == pytest.approx([3.0, 1.0, 2.0])
    # RViz sends goals on the ground: they are flown to at the height of the drone.
    corridor.stream.add("/goal_pose", GOAL, goal_message(Goal((8.0, 1.0, 0.0)), 1).data)
    source.advance()
    assert np.asarray(source.observe().goal.position) == pytest.approx([8.0, 1.0, 1.5])


def test_far_from_the_origin_goals_are_counted_from_the_first_pose(corridor: Corridor):
    far = np.array([5000.0, 0.0, 80.0])
    setup = replace(find_setup(corridor.stream, Wanted()), offset=far)
    source = StreamSource(corridor.stream, setup, goal_topic="/goal_pose")
    position = np.asarray(source.observe().state.position)
    for height, expected in ((0.0, position[2]), (81.0, 1.0)):
        corridor.stream.add("/goal_pose", GOAL, goal_message(Goal((5008.0, 1.0, height)), 1).data)
        source.advance()
        assert np.asarray(source.observe().goal.position) == pytest.approx([8.0, 1.0, expected])


def test_a_silent_topic_is_named_and_its_return_is_survived(corridor: Corridor):
    start = corridor.now - 10_000_000_000
    silent = Corridor(Stream("silent"), start, start=start)
    silent.fly(2.0)
    source = source_of(silent)
    assert "/points is silent for" in (source.explanation or "")
    assert source.observe().cloud_age > 5.0
    silent.now = silent.stream.clock.now() - 1_000_000_000
    silent.fly(1.0)
    source.advance()
    assert "silent" not in (source.explanation or "") and source.observe().cloud_age < 1.0


def test_a_goal_must_be_finite(corridor: Corridor):
    with pytest.raises(UserError, match="three finite numbers"):
        source_of(corridor, goal=(np.nan, 0.0, 0.0))


def test_without_a_sweep_there_is_no_source(corridor: Corridor):
    setup, empty = find_setup(corridor.stream, Wanted()), Stream("empty")
    empty.health("/points", setup.points_type)
    with pytest.raises(UserError, match="empty has no sweep with a pose yet"):
        StreamSource(empty, setup)
