"""A recording as a source: ticks, accumulated cloud, goal."""

import bags
import numpy as np
import pytest

from aero_planner import Planner, PlannerConfig
from aero_viz.errors import UserError
from aero_viz.recordings import RecordingSource, open_recording
from aero_viz.recordings.source import MAX_POINTS
from tests.planner.pillars import dynamic_obstacles, pillar_points


@pytest.fixture
def source_of(mcap_of):
    opened = []

    def build(items, **options):
        opened.append(RecordingSource(open_recording(mcap_of(items)), **options))
        return opened[-1]

    yield build
    for source in opened:
        source.close()


def play(source):
    seen = []
    while source.outcome is None:
        seen.append(source.observe())
        source.advance(None)
    return seen


def test_one_tick_per_pose_until_the_end(source_of):
    source = source_of(bags.drive())
    seen = play(source)
    np.testing.assert_allclose([o.time for o in seen], 0.025 * np.arange(37), atol=1e-9)
    assert source.outcome == "end" and source.info.period == pytest.approx(0.025) and not source.info.closed_loop
    for o in seen:
        np.testing.assert_allclose(o.state.position, [2 * o.time, 0, 0], atol=1e-6)
        np.testing.assert_allclose(o.state.velocity, [2, 0, 0], atol=1e-6)
        assert o.state.time == o.time


def test_sweeps_from_all_positions_coincide_in_the_world(source_of):
    for o in play(source_of(bags.drive(sweeps=14))):
        count = min(int(o.time / 0.1 + 1e-6) + 1, 10)
        newest = 0.1 * min(int(o.time / 0.1 + 1e-6), 13)
        assert o.cloud_age == pytest.approx(o.time - newest, abs=1e-6)
        assert len(o.sweeps) == count and o.points.shape == (200 * count, 3) and o.points.dtype == np.float32
        # The wall is at x = 5 m, wherever the drone was when it measured it.
        np.testing.assert_allclose(o.points[:, 0], 5.0, atol=1e-5)


def test_number_of_sweeps_can_be_chosen(source_of):
    assert len(play(source_of(bags.drive(), sweeps=3))[-1].sweeps) == 3
    with pytest.raises(UserError, match="sweeps must be at least 1"):
        source_of(bags.drive(), sweeps=0)


def test_cloud_has_the_newest_sweeps_that_fit_whole(source_of):
    big = np.tile(bags.wall(1000), (70, 1))
    items = [bags.cloud(0.1 * k, bags.xyz(np.add(big, [k, 0, 0]))) for k in range(5)]
    items += [bags.pose_stamped(0.1 * k, [0, 0, 0]) for k in range(5)]
    o = play(source_of(items))[-1]
    assert len(o.sweeps) == 2 and len(o.points) == 140_000 <= MAX_POINTS
    assert set(np.unique(o.points[:, 0])) == {8.0, 9.0}


def test_newest_sweep_is_used_even_if_it_exceeds_the_limit(source_of):
    big = np.tile(bags.wall(1000), (220, 1))
    o = play(source_of([bags.cloud(0, bags.xyz(big)), bags.pose_stamped(0, [0, 0, 0])]))[0]
    assert len(o.sweeps) == 1 and len(o.points) == 220_000


def fast_turn(pose_period: float):
    """Return a sweep of a sensor that turns at 2 rad/s, moves at 3 m/s, and measures a post at (4, 1) 200 times."""
    seconds = np.arange(200) * 5e-4
    yaw, x = 2.0 * seconds, 3.0 * seconds
    post = np.stack([4.0 - x, np.full(200, 1.0)], axis=1)
    seen = np.stack(
        [np.cos(yaw) * post[:, 0] + np.sin(yaw) * post[:, 1], np.cos(yaw) * post[:, 1] - np.sin(yaw) * post[:, 0],
         np.linspace(-1, 1, 200)], axis=1)  # fmt: skip
    items = [bags.cloud(0, {**bags.xyz(seen), "t": (seconds * 1e9).astype("u4")})]
    for t in np.arange(0, 1.0, pose_period):
        items.append(bags.pose_stamped(t, [3 * t, 0, 0], (np.cos(t), 0, 0, np.sin(t))))
    return items


def test_points_are_moved_by_the_pose_at_their_own_time(source_of):
    points = source_of(fast_turn(0.05)).observe().points
    assert np.abs(points[:, :2] - [4, 1]).max() < 2e-3


def test_sparse_poses_move_a_sweep_as_a_whole(source_of):
    points = source_of(fast_turn(0.45)).observe().points
    np.testing.assert_allclose(points[0, :2], [4, 1], atol=1e-5)
    assert np.abs(points[-1, :2] - [4, 1]).max() > 0.2


@pytest.mark.parametrize("has_point_times", [True, False])
def test_what_moves_is_predicted_from_when_it_was_measured(source_of, has_point_times):
    """A sweep has the stamp of its first point, and is planned from before its last one, or that of its last point."""
    seconds, velocity, items = np.linspace(0.0, 0.1, 1500), np.array([0.0, 1.5, 0.0]), []
    for k in range(12):
        middle = np.array([5.0, -1.0]) + (0.1 * k + 0.05) * velocity[:2]
        seen = bags.xyz(pillar_points(middle, np.zeros(3), seed=k) + np.outer(seconds - 0.05, velocity))
        times = {"t": (seconds * 1e9).astype("u4")} if has_point_times else {}
        items.append(bags.cloud(0.1 * k + (0.0 if has_point_times else 0.1), seen | times))
    source = source_of([*items, *(bags.pose_stamped(0.02 * k, [0, 0, 0]) for k in range(70))])
    source.seek(1.0)
    o = source.observe()
    planner = Planner(PlannerConfig.preset("fast-cpu"), device="cpu")
    positions, velocities, _ = dynamic_obstacles(planner.plan(o.state, o.goal, o.sweeps))
    now = o.time + (0.0 if has_point_times else 0.1)
    np.testing.assert_allclose(positions, [np.array([5.0, -1.0]) + now * velocity[:2]], atol=0.1)
    np.testing.assert_allclose(velocities, [velocity[:2]], atol=0.15)


def test_goal_moves_along_the_recorded_path(source_of):
    corner = [[k * 0.5, 0, 0] for k in range(21)] + [[10, k * 0.5, 0] for k in range(1, 21)]
    items = [bags.pose_stamped(0.1 * k, p) for k, p in enumerate(corner)]
    items += [bags.cloud(0.1 * k, bags.xyz(bags.wall())) for k in range(41)]
    source = source_of(items, goal_ahead=5.0)
    np.testing.assert_allclose(source.observe().goal.position, [5, 0, 0], atol=1e-6)
    source.seek(1.6)
    np.testing.assert_allclose(source.observe().goal.position, [10, 3, 0], atol=1e-6)
    source.goal_ahead = 8.0
    np.testing.assert_allclose(source.observe().goal.position, [10, 6, 0], atol=1e-6)
    source.seek(3.6)  # 2 m before the end
    np.testing.assert_allclose(source.observe().goal.position, [10, 10, 0], atol=1e-6)
    source.seek(3.95)  # less than 1 m: along the heading, which is x
    np.testing.assert_allclose(source.observe().goal.position, [10 + 8, 9.5, 0], atol=1e-6)
    with pytest.raises(UserError, match="goal_ahead must be a positive number"):
        source.goal_ahead = 0.0


def test_goal_of_a_standing_drone_is_along_its_heading(source_of):
    jitter = np.random.default_rng(1).normal(0, 0.01, (200, 3))
    yaw = np.array([np.cos(0.3), 0, 0, np.sin(0.3)])
    items = [bags.pose_stamped(0.01 * k, jitter[k], yaw) for k in range(200)]
    source = source_of([*items, *(bags.cloud(0.1 * k, bags.xyz(bags.wall())) for k in range(20))])
    source.seek(1.0)
    o = source.observe()
    offset = np.asarray(o.goal.position) - np.asarray(o.state.position)
    np.testing.assert_allclose(offset, [15 * np.cos(0.6), 15 * np.sin(0.6), 0], atol=1e-6)


def test_fixed_goal_stays_until_it_is_reset(source_of):
    source = source_of(bags.drive())
    automatic = np.array(source.observe().goal.position)
    source.set_goal([1, 2, 3])
    source.seek(0.5)
    np.testing.assert_array_equal(source.observe().goal.position, [1, 2, 3])
    source.set_goal(None)
    source.seek(0.0)
    np.testing.assert_array_equal(source.observe().goal.position, automatic)
    with pytest.raises(UserError, match="three finite numbers"):
        source.set_goal([1, np.nan, 2])


def test_checkpoint_restores_tick_goal_and_outcome(source_of):
    source = source_of(bags.drive())
    source.seek(0.5)
    saved, before = source.checkpoint(), source.observe()
    play(source)
    source.set_goal([0, 0, 0])
    source.goal_ahead = 2.0
    source.restore(saved)
    after = source.observe()
    assert source.outcome is None and after.time == before.time
    np.testing.assert_array_equal(after.points, before.points)
    np.testing.assert_array_equal(after.goal.position, before.goal.position)


def test_seek_goes_to_the_tick_at_or_before(source_of):
    source = source_of(bags.drive())
    for time, expected in [(0.26, 0.25), (-5.0, 0.0), (100.0, 0.9)]:
        source.seek(time)
        assert source.observe().time == pytest.approx(expected)
    play(source)
    source.seek(0.1)
    assert source.outcome is None
    with pytest.raises(UserError, match="Cannot seek"):
        source.seek(np.nan)


def test_recording_without_poses_plays_at_the_origin(source_of):
    source = source_of([bags.cloud(0.1 * k, bags.xyz(bags.wall(seed=k))) for k in range(4)])
    assert any("no poses are recorded" in notice for notice in source.info.notices)
    seen = play(source)
    assert len(seen) == 4 and len(seen[-1].sweeps) == 4
    np.testing.assert_array_equal(seen[-1].state.quaternion, [1, 0, 0, 0])
    np.testing.assert_array_equal(seen[-1].goal.position, [15, 0, 0])


def test_scenery_shows_the_recorded_path(source_of):
    source = source_of(bags.drive())
    np.testing.assert_allclose(source.info.recorded_path[-1], [1.8, 0, 0], atol=1e-6)
    assert source.info.world is None and "Open loop" in source.info.notices[0]
