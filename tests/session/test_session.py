"""The engine on a real flight: time, jumps, parameters, sinks, and failures."""

import gc
import threading
import time
import weakref
from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from ensemble_plans import plan_of
from small_source import small_config, small_source, wait_for

from aero_planner import PlannerConfig
from aero_planner.array_memory import allocate
from aero_planner.arrays import Sizes
from aero_viz.errors import UserError
from aero_viz.flight import FlightSource
from aero_viz.scenes import World
from aero_viz.sensors import LidarModel
from aero_viz.session import Session
from aero_viz.session.frame import Frame, Notice
from aero_viz.session.source import Observation


@pytest.fixture
def session() -> Iterator[Session]:
    session = Session(small_source(), config=small_config(), seed=3)
    yield session
    session.close()


@pytest.fixture
def live(session: Session) -> Session:
    session.start(play=False)
    wait_for(lambda: session.frame is not None)
    return session


class Shortsighted(FlightSource):
    """Accepts a goal beyond 25 m but fails to observe with it."""

    def observe(self) -> Observation:
        observation = super().observe()
        if np.asarray(observation.goal.position)[0] > 25.0:
            raise ValueError("goal.position is too far.")
        return observation


def same_plan(a: Frame, b: Frame) -> bool:
    return np.array_equal(plan_of(a).controls, plan_of(b).controls) and np.array_equal(
        a.plan.positions, b.plan.positions
    )


def run(session: Session, count: int) -> list[Frame]:
    return [session.tick() for _ in range(count)]


def test_a_flight_arrives_and_further_ticks_return_its_last_frame(session: Session):
    frame = session.tick()
    while frame.outcome is None:
        frame = session.tick()
    assert frame.outcome == "arrived"
    assert session.tick() is frame
    assert np.linalg.norm(frame.trail[-1] - [12.0, 0.0, 2.0]) < 1.05
    assert len(frame.trail) == frame.index + 1


def test_frames_do_not_change_after_they_are_published(session: Session):
    first = session.tick()
    controls, points = plan_of(first).controls.copy(), first.observation.points.copy()
    run(session, 5)
    np.testing.assert_array_equal(plan_of(first).controls, controls)
    np.testing.assert_array_equal(first.observation.points, points)
    assert len(first.trail) == 1


def test_going_back_repeats_the_flight_bit_for_bit(session: Session):
    frames = run(session, 12)
    session.seek(frames[4].time).result()
    assert session.frame is not None
    assert session.frame.index == 4
    assert same_plan(session.frame, frames[4])
    for frame in frames[5:]:
        assert same_plan(session.tick(), frame)


def test_changed_weights_change_the_flight_after_a_step_back(session: Session):
    frames = run(session, 12)
    session.step(-8).result()
    session.configure({"costs.q_control": 30.0})
    again = run(session, 8)
    assert again[-1].index == frames[-1].index
    assert not np.array_equal(again[-1].trail, frames[-1].trail)
    assert again[-1].epoch != frames[-1].epoch


def test_a_weight_changes_the_plan_while_paused_and_undo_restores_it(live: Session):
    live.step(3).result()
    before = live.frame
    assert before is not None
    live.configure({"costs.q_position": 30.0})
    wait_for(lambda: live.frame is not before)
    changed = live.frame
    assert changed is not None
    assert changed.time == before.time
    assert changed.config.costs.q_position == 30.0
    assert not same_plan(changed, before)
    live.undo()
    wait_for(lambda: live.frame is not changed)
    assert live.frame is not None
    assert same_plan(live.frame, before)


def test_a_structural_change_takes_effect_while_paused(live: Session):
    live.configure({"sampling.samples": 8, "anchors.columns": 3})
    wait_for(lambda: live.frame is not None and plan_of(live.frame).stage1_cost.shape == (3 * 3 + 1, 8))


def test_undoing_a_structural_change_restores_the_plan(session: Session):
    before = run(session, 4)[-1]
    session.configure({"sampling.steps": 20})
    assert session.frame is not None and plan_of(session.frame).controls.shape[1] == 20
    session.undo()
    assert same_plan(session.frame, before)


def test_a_refused_parameter_changes_nothing(live: Session):
    with pytest.raises(ValueError, match=r"costs\.q_track"):
        live.configure({"costs.q_track": -5.0})
    assert live.config == small_config()


def test_play_pause_and_step(live: Session):
    live.play()
    wait_for(lambda: live.frame is not None and live.frame.index >= 5)
    live.pause()
    wait_for(lambda: not live.playing)
    assert live.frame is not None
    index = live.frame.index
    time.sleep(0.1)
    assert live.frame.index == index
    live.step().result()
    assert live.frame.index == index + 1
    live.step(-2).result()
    assert live.frame.index == index - 1


def test_time_follows_the_clock(live: Session):
    live.set_speed(0.5)
    started = time.monotonic()
    live.play()
    wait_for(lambda: live.frame is not None and live.frame.time >= 0.4)
    # A busy machine may be late, never early.
    assert time.monotonic() - started >= 0.7


def test_a_flight_catches_up_with_a_short_delay_and_slows_down_after_a_long_one(
    live: Session, monkeypatch: pytest.MonkeyPatch
):
    wall = [time.monotonic()]
    monkeypatch.setattr("aero_viz.session.clock.time", SimpleNamespace(monotonic=lambda: wall[0]))
    monkeypatch.setattr("aero_viz.session.session._CATCH_UP", 60.0)
    live.set_speed(0.01)  # two seconds of wall time per tick
    live.play()

    def ticks_after(delay: float, *, expected: int) -> int:
        assert live.frame is not None
        before = live.frame.index
        wall[0] += delay
        live.set_speed(0.01)  # the session looks at the clock again
        wait_for(lambda: live.frame is not None and live.frame.index >= before + expected)
        time.sleep(0.5)  # the clock stands still, so no further tick is due; the session waits for two seconds
        return live.frame.index - before

    wait_for(lambda: live.frame is not None and live.frame.index == 1)
    assert ticks_after(30.0, expected=15) == 15
    assert ticks_after(90.0, expected=1) == 1
    assert live.frame is not None and live.frame.dropped_ticks == 0, "a flight loses no tick: it runs slower"


@pytest.mark.parametrize("speed", [0.0, -1.0, 1e9, float("nan")])
def test_a_speed_out_of_bounds_is_refused(session: Session, speed: float):
    with pytest.raises(ValueError, match="speed is"):
        session.set_speed(speed)


def test_a_moved_goal_changes_the_plan(live: Session):
    before = live.frame
    live.set_goal([0.0, 12.0, 2.0]).result()
    assert live.frame is not None and before is not None
    assert not same_plan(live.frame, before)
    np.testing.assert_array_equal(live.frame.observation.goal.position, [0.0, 12.0, 2.0])


def test_a_moved_goal_is_kept_when_stepping_back_to_its_tick(session: Session):
    run(session, 5)
    session.set_goal([0.0, 12.0, 2.0])
    run(session, 1)
    session.step(-1)
    assert session.frame is not None
    assert session.frame.index == 4
    np.testing.assert_array_equal(session.frame.observation.goal.position, [0.0, 12.0, 2.0])


def test_a_failed_structural_change_leaves_the_last_good_one(session: Session, monkeypatch: pytest.MonkeyPatch):
    run(session, 3)
    session.configure({"costs.q_track": 9.0})
    good = session.config

    def out_of_memory(kind: type, sizes: Sizes, device: wp.Device, **present: wp.array) -> object:
        if sizes.K > 1000:
            raise MemoryError("no room")
        return allocate(kind, sizes, device, **present)

    monkeypatch.setattr("aero_planner.structure.allocate", out_of_memory)
    session.configure({"sampling.samples": 2000})
    assert session.config == good
    assert plan_of(run(session, 2)[-1]).stage1_cost.shape == (16, 16)
    assert session.undo() == session.config == small_config()


@pytest.mark.parametrize("goal", [[1.0, 2.0], [np.nan, 0.0, 0.0], [np.inf, 0.0, 0.0]])
def test_an_impossible_goal_is_refused(session: Session, goal: list[float]):
    with pytest.raises(ValueError, match="three finite numbers"):
        session.set_goal(goal)


def test_a_goal_too_far_for_a_number_is_refused_with_a_notice_and_the_previous_one_stays(live: Session):
    notices: list[Notice] = []
    live.subscribe_notices(notices.append)
    with pytest.raises(UserError, match="goal stays"):
        live.set_goal([1e30, 0.0, 2.0], quiet=True).result()
    assert live.set_goal([1e30, 0.0, 2.0]).exception() is not None
    live.set_goal([0.0, 12.0, 2.0]).result()
    wait_for(lambda: notices)
    assert [(n.level, "goal stays" in n.text) for n in notices] == [("error", True)]
    assert live.frame is not None
    np.testing.assert_array_equal(live.frame.observation.goal.position, [0.0, 12.0, 2.0])


def test_frames_say_that_a_goal_lies_in_an_obstacle(live: Session):
    live.set_goal([4.0, 0.3, 2.0]).result()
    wait_for(lambda: live.frame is not None and "inside an obstacle" in str(live.frame.explanation))
    live.set_goal([0.0, 12.0, 2.0]).result()
    wait_for(lambda: live.frame is not None and live.frame.explanation is None)


def test_a_goal_whose_plan_fails_leaves_the_previous_one():
    session = Session(small_source(goal=20.0, kind=Shortsighted), config=small_config())
    before = run(session, 3)[-1]
    with pytest.raises(ValueError, match=r"goal\.position"):
        session.set_goal([26.0, 0.0, 2.0]).result()
    after = run(session, 1)[-1]
    np.testing.assert_array_equal(after.observation.goal.position, [20.0, 0.0, 2.0])
    session.seek(before.time)
    assert session.frame is not None and same_plan(session.frame, before)
    session.close()


def test_subscribers_hear_of_every_pause_and_resumption(live: Session):
    states: list[bool] = []
    sink = live.subscribe_playing(states.append)
    live.play()
    live.play()
    live.pause()
    live.set_speed(100.0)
    live.play()
    wait_for(lambda: live.frame is not None and live.frame.outcome is not None)
    wait_for(lambda: len(states) == 5)
    assert states == [False, True, False, True, False]
    live.unsubscribe(sink)


def test_frames_include_samples_on_request(live: Session):
    assert plan_of(live.frame).samples is None
    live.set_samples(True).result()
    samples = plan_of(live.frame).samples
    assert samples is not None and samples.shape == (16, 16, 26, 3)


def test_a_new_source_starts_from_its_beginning(live: Session):
    live.step(4).result()
    live.set_source(small_source(goal=20.0)).result()
    assert live.frame is not None
    assert live.frame.index == 0
    assert live.source.world is not None
    assert live.source.world.goal[0] == 20.0


def test_the_source_before_is_freed_at_once(live: Session):
    live.step(2).result()
    before = weakref.ref(live.source)
    gc.disable()
    try:
        live.set_source(small_source(goal=20.0)).result()
        wait_for(lambda: before() is None)
    finally:
        gc.enable()


def test_a_source_whose_first_tick_fails_leaves_the_old_one(live: Session):
    notices: list[Notice] = []
    live.subscribe_notices(notices.append)
    live.step(2).result()
    old, frame, config = live.source, live.frame, live.config
    future = live.set_source(
        small_source(goal=26.0, kind=Shortsighted), convert=lambda c: c.replace({"costs.q_track": 9.0})
    )
    with pytest.raises(ValueError, match=r"goal\.position"):
        future.result()
    assert live.source is old and live.config == config
    live.step().result()
    assert live.frame is not None and frame is not None
    assert live.frame.index == frame.index + 1
    wait_for(lambda: any(n.level == "error" and "goal" in n.text for n in notices))


def test_a_sink_that_hangs_or_raises_affects_neither_the_engine_nor_other_sinks(live: Session):
    seen: list[int] = []

    def raises(frame: Frame) -> None:
        raise RuntimeError("a broken sink")

    broken = live.subscribe(raises)
    gate = threading.Event()

    def hangs(frame: Frame) -> None:
        gate.wait(60.0)

    hanging = live.subscribe(hangs)
    every = live.subscribe(lambda frame: seen.append(frame.index), every=True)
    live.step(20).result()
    assert every.drain() and broken.drain()
    assert seen == list(range(21))
    assert broken.failures >= 1
    assert hanging.dropped >= 1
    gate.set()


def test_the_outcome_is_announced_once(live: Session):
    notices: list[Notice] = []
    live.subscribe_notices(notices.append)
    live.set_speed(100.0)
    live.play()
    wait_for(lambda: live.frame is not None and live.frame.outcome == "arrived")
    wait_for(lambda: not live.playing and notices)
    assert [n.text for n in notices] == ["poles: arrived at the goal."]


def test_a_flight_that_continues_to_another_goal_announces_its_second_outcome_too(session: Session):
    notices: list[Notice] = []
    sink = session.subscribe_notices(notices.append)
    for goal in ([12.0, 0.0, 2.0], [12.0, 8.0, 2.0], [12.0, 8.0, 2.0]):
        session.set_goal(goal).result()
        while session.tick().outcome is None:
            pass
        session.tick()
    assert sink.drain()
    assert [n.text for n in notices] == 3 * ["poles: arrived at the goal."]


def test_a_flight_that_cannot_start_explains_why(live: Session):
    notices: list[Notice] = []
    live.subscribe_notices(notices.append)
    pole = World("pole", np.zeros(3), np.array([9.0, 0.0, 0.0]), spheres=np.array([[0.1, 0.0, 0.0, 0.5]]))
    live.set_source(FlightSource(pole, lidar=LidarModel("sparse", points_per_sweep=2000))).result()
    assert live.frame is not None and live.frame.source is live.source
    assert live.frame.outcome == "collision"
    explanation = live.frame.explanation
    assert explanation is not None and "start" in explanation
    live.play()
    wait_for(lambda: any(n.text == f"pole: collided. {explanation}" for n in notices))


def test_playing_after_the_end_starts_again(live: Session):
    live.set_speed(100.0)
    live.play()
    wait_for(lambda: live.frame is not None and live.frame.outcome == "arrived" and not live.playing)
    live.set_speed(0.01)  # slow enough not to end once more before it is looked at
    live.play()
    wait_for(lambda: live.frame is not None and live.frame.outcome is None and live.playing)


def test_a_new_speed_shortens_the_wait_for_the_next_tick(live: Session):
    live.set_speed(0.01)
    live.play()
    live.set_speed(100.0)
    wait_for(lambda: live.frame is not None and live.frame.index >= 20)


def test_two_sessions_with_equal_seeds_fly_equally():
    trails = []
    for _ in range(2):
        session = Session(small_source(), config=small_config(), seed=5)
        trails.append(run(session, 10)[-1].trail)
        session.close()
    np.testing.assert_array_equal(*trails)


def test_the_default_configuration_is_used_when_none_is_given():
    session = Session(small_source())
    assert session.config == PlannerConfig()
    session.close()


@pytest.mark.parametrize("time", [float("nan"), float("inf")])
def test_a_time_that_is_none_is_refused_at_once(session: Session, time: float):
    with pytest.raises(ValueError, match="it must be a finite number"):
        session.seek(time)
