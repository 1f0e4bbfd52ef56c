"""Replays of flight logs: goal, plans, outcome and world as they were."""

import json
import shutil
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from small_source import small_config, small_source

from aero_planner.missions import Mission, Waypoint
from aero_viz.catalog import open_source
from aero_viz.errors import UserError
from aero_viz.logs import flight_recorder
from aero_viz.logs.log_contents import LogContents, is_flight_log, read_log
from aero_viz.logs.replay import FlightReplay
from aero_viz.recordings import open_recording
from aero_viz.scenes.obstacles import new_obstacle, with_obstacle
from aero_viz.session import Session
from aero_viz.session.frame import Frame


@pytest.fixture(scope="module")
def flown(tmp_path_factory) -> tuple[str, list[Frame]]:
    """A log of a flight whose goal moves after ten ticks, and the frames of that flight."""
    path = tmp_path_factory.mktemp("log") / "flight.mcap"
    session = Session(small_source(), config=small_config())
    frames: list[Frame] = []
    with flight_recorder(path) as log:
        while not frames or frames[-1].outcome is None:
            frames.append(session.tick())
            log.write(frames[-1])
            if len(frames) == 10:
                session.set_goal(np.add(frames[-1].observation.goal.position, (0.0, 0.4, 0.2))).result()
    session.close()
    return str(path), frames


@pytest.fixture
def replay(flown) -> Iterator[Any]:
    source = open_source(flown[0])
    assert isinstance(source, FlightReplay)
    yield source
    source.close()


def at(frames: list[Frame], time: float) -> Frame:
    return min(frames, key=lambda frame: abs(frame.time - time))


def test_the_motion_stays_in_the_frame_of_the_world(flown, replay):
    frames = flown[1]
    assert replay.info.world.name == frames[0].source.world.name
    state = replay.observe().state
    start = np.asarray(at(frames, 0.0).observation.actual_state.position)
    np.testing.assert_allclose(np.asarray(state.position), start, atol=1e-5)
    assert np.linalg.norm(state.position) > 0.5, "the first pose is not moved to the origin"


def test_goal_and_plan_of_every_tick_are_those_of_the_log(flown, replay):
    frames = flown[1]
    goals = set()
    for time in replay.info.times:
        replay.seek(time)
        observation, frame = replay.observe(), at(frames, time)
        plan = replay.info.recorded_plan(time)
        best = int(frame.plan.best)
        assert (plan.best, plan.kinds, plan.status) == (best, frame.plan.kinds, frame.plan.status)
        np.testing.assert_allclose(plan.path, frame.plan.positions[best], atol=1e-5)
        np.testing.assert_allclose(plan.stage2_cost, frame.plan.cost, rtol=1e-6)
        goals.add(tuple(np.round(observation.goal.position, 6)))
        assert observation.ground_height == frame.observation.ground_height
    assert goals == {tuple(np.round(frame.observation.goal.position, 6)) for frame in frames[10:] + frames[:9]}


def test_the_world_of_every_tick_is_that_of_the_log(tmp_path):
    path = tmp_path / "flight.mcap"
    session = Session(small_source(), config=small_config())
    frames: list[Frame] = []
    ball = new_obstacle("sphere", [0.0, 30.0, 2.0], [1.0, 1.0, 1.0])
    with flight_recorder(path) as log:
        for tick in range(30):
            frames.append(session.tick())
            log.write(frames[-1])
            if tick == 10:
                session.alter(lambda source: source.set_world(with_obstacle(source.observe().world, ball))).result()
            if tick == 20:
                session.alter(lambda source: source.set_conditions({"lidar.dropout": 0.5})).result()
    session.close()
    replay = open_source(str(path))
    assert replay.info.times is not None
    counts = []
    for time in replay.info.times:
        replay.seek(time)
        counts.append(len(replay.observe().world.spheres))  # type: ignore[union-attr]
    replay.close()
    before = len(frames[0].world.spheres)  # type: ignore[union-attr]
    assert sorted(counts) == counts and set(counts) == {before, before + 1}
    assert replay.info.times[counts.index(before + 1)] == pytest.approx(frames[11].time, abs=0.11)
    with path.open("rb") as file:
        files = {item.name: item.data for item in make_reader(file).iter_attachments()}
    attached = {name: json.loads(data) for name, data in files.items() if "change" in name}
    assert list(attached) == ["world_change_1.json", "conditions_change_2.json"]
    assert attached["conditions_change_2.json"]["lidar.dropout"] == 0.5


def test_the_outcome_is_told_at_the_start_and_at_the_end(flown, replay):
    outcome = flown[1][-1].outcome
    assert outcome is not None
    assert any(outcome.replace("_", " ") in notice for notice in replay.info.notices)
    session = Session(replay, config=small_config())
    session.seek(replay.info.times[-1]).result()
    frame = session.tick()
    assert frame.outcome == "end"
    assert outcome.replace("_", " ") in str(frame.explanation)


def test_the_content_of_a_file_makes_it_a_flight_log_not_its_name(flown, tmp_path):
    path = shutil.copy(flown[0], tmp_path / "flight.log")
    source = open_source(str(path))
    assert isinstance(source, FlightReplay)
    source.close()


def test_other_files_are_no_flight_logs(tmp_path):
    (tmp_path / "text.mcap").write_text("no MCAP")
    assert not is_flight_log(tmp_path / "text.mcap")
    assert not is_flight_log(tmp_path / "absent.mcap")
    assert not is_flight_log(tmp_path)


def test_the_leg_of_every_tick_is_that_of_the_log(tmp_path):
    path, route = tmp_path / "flight.mcap", ["3,1,2,speed=3", "6,-4,2", "9,-4,2,stop,speed=2"]
    source = small_source()
    source.set_mission(Mission(tuple(map(Waypoint.parse, route))))
    session = Session(source, config=small_config())
    frames: list[Frame] = []
    with flight_recorder(path) as log:
        while not frames or frames[-1].outcome is None:
            frames.append(session.tick())
            log.write(frames[-1])
    session.close()
    assert frames[-1].outcome == "arrived"
    replay = FlightReplay(open_recording(str(path)), path)
    again = Session(replay, config=read_log(path).config())
    try:
        assert replay.info.times is not None
        for time in (*replay.info.times[::3], replay.info.times[-1]):
            again.seek(float(time)).result()
            shown, flown = again.frame, at(frames, time)
            assert shown is not None and shown.observation.mission is not None and flown.observation.mission is not None
            before, after = flown.observation.mission, shown.observation.mission
            assert (after.index, after.events, after.mission) == (before.index, before.events, before.mission)
            assert shown.config == flown.config
            np.testing.assert_allclose(
                np.asarray(shown.observation.goal.position), np.asarray(flown.observation.goal.position), atol=1e-6
            )
    finally:
        again.close()
    assert {frame.config.vehicle.speed_limit for frame in frames} == {3.0, 7.0, 2.0}


MISSION = {"waypoints": [{"position": [0, 0, 0]}]}


@pytest.mark.parametrize(
    "content", [[], {"progress": {}}, {"mission": MISSION, "progress": {"index": 9, "since": 0, "events": []}}]
)
def test_a_damaged_leg_is_refused(content):
    contents = LogContents("f.mcap", {"leg_change_1.json": json.dumps(content).encode()}, {"leg_change_1.json": 0})
    with pytest.raises(UserError, match=r"The leg leg_change_1\.json in f\.mcap is damaged: "):
        contents.legs()
