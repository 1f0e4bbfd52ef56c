"""The session of a stream: the picture is held and moved while plans go on; recordings play back bit for bit."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path

import numpy as np
import pytest

from aero_viz.catalog import open_source
from aero_viz.errors import UserError
from aero_viz.live.record import Recorder
from aero_viz.live.replay import is_stream_recording, recorded_config
from aero_viz.live.session import StreamSession
from aero_viz.recordings.contents import read_contents
from aero_viz.recordings.mcap_file import MCAP_MAGIC
from aero_viz.recordings.storage import open_storage
from aero_viz.session import Session
from aero_viz.session.frame import Frame
from tests.live.conftest import Corridor, Open


def ticks_of(session: StreamSession, corridor: Corridor, count: int) -> list[Frame]:
    """Return some ticks, between which 50 ms of messages arrive."""
    frames = []
    for _ in range(count):
        corridor.fly(0.05)
        frames.append(session.tick())
    return frames


def same(a: Frame, b: Frame) -> bool:
    """Return True if two plans are the same, bit for bit."""
    arrays = ("cost", "positions", "controls")
    return all(np.array_equal(getattr(a.plan, name), getattr(b.plan, name)) for name in arrays)


def test_the_picture_is_held_while_ticks_go_on(corridor: Corridor, open_session: Open):
    session = open_session()
    shown = ticks_of(session, corridor, 5)
    session.pause()
    behind = ticks_of(session, corridor, 3)
    assert session.frame is shown[-1] and not session.playing
    assert behind[0].index == 5 and session.time_range[1] == behind[-1].time
    session.play()
    following = ticks_of(session, corridor, 1)
    assert session.frame is following[0] and following[0].index == 8
    assert following[0].epoch != shown[-1].epoch  # the page redraws its history


def test_a_tick_that_fails_leaves_the_picture_and_the_ticks_to_come(
    corridor: Corridor, open_session: Open, monkeypatch: pytest.MonkeyPatch
):
    session = open_session()
    frames = ticks_of(session, corridor, 4)
    session.seek(frames[1].time).result()
    held = session.frame
    assert held is not None

    def fail() -> None:
        raise ValueError("out of memory")

    with monkeypatch.context() as broken, pytest.raises(ValueError, match="out of memory"):
        broken.setattr(session.stream_source, "observe", fail)
        ticks_of(session, corridor, 1)
    assert session.frame is held and ticks_of(session, corridor, 1)[0].index == 4
    session.configure({"costs.q_position": 9.0})
    again = session.frame
    assert again is not None and again is not held and (again.index, again.time) == (1, held.time)


def test_a_past_tick_is_planned_again_with_other_weights(corridor: Corridor, open_session: Open):
    session = open_session()
    frames = ticks_of(session, corridor, 4)
    session.seek(frames[1].time).result()
    assert session.frame is not None and same(session.frame, frames[1])
    session.configure({"costs.q_position": 9.0})
    assert session.frame.index == 1 and not same(session.frame, frames[1])
    session.undo()
    session.step(1).result()
    assert session.frame.index == 2 and same(session.frame, frames[2])


def test_a_recording_plays_back_bit_for_bit(corridor: Corridor, open_session: Open, tmp_path: Path):
    session = open_session(goal=(20.0, 1.0, 1.5))
    ticks_of(session, corridor, 4)
    session.record(tmp_path / "live.mcap").result()
    frames = ticks_of(session, corridor, 4)
    session.pause()  # recording goes on
    frames += ticks_of(session, corridor, 3)
    session.seek(frames[0].time).result()
    session.configure({"costs.q_position": 9.0})  # looking back leaves no trace in the plans to come
    session.undo()
    frames += ticks_of(session, corridor, 3)
    deadline = time.monotonic() + 30.0
    while session.recorder is not None and session.recorder.ticks < len(frames) and time.monotonic() < deadline:
        time.sleep(0.02)
    session.stop_recording().result()

    assert is_stream_recording(tmp_path / "live.mcap")
    source = open_source(str(tmp_path / "live.mcap"))
    replay = Session(source)
    played = [replay.tick() for _ in frames]
    assert [frame.time for frame in played] == [frame.time for frame in frames]
    for live, again in zip(frames, played, strict=True):
        assert np.array_equal(live.observation.points, again.observation.points)
        assert same(live, again)
        assert again.recorded_plan is not None and again.recorded_plan.best == live.plan.best
        assert np.array_equal(again.recorded_plan.path, live.plan.positions[live.plan.best])
    assert replay.tick().outcome == "end"
    replay.close()


def test_a_recording_holds_the_messages_as_they_came(corridor: Corridor, open_session: Open, tmp_path: Path):
    session = open_session()
    session.record(tmp_path / "live.mcap").result()
    ticks_of(session, corridor, 8)
    session.stop_recording().result()
    with contextlib.closing(open_storage(tmp_path / "live.mcap")) as storage:
        counts = {topic.name: topic.count for topic in read_contents(storage).topics}
    assert counts["/points"] == corridor.stream.topics["/points"].count
    assert counts["/odometry"] == corridor.stream.topics["/odometry"].count
    assert counts["/aero_viz/tick"] == counts["/plan"] == 8


def test_a_recording_plays_with_its_first_configuration(corridor: Corridor, open_session: Open, tmp_path: Path):
    session = open_session()
    first = session.configure({"costs.q_position": 9.0})
    session.record(tmp_path / "live.mcap").result()
    ticks_of(session, corridor, 2)
    session.configure({"costs.q_position": 4.0})
    ticks_of(session, corridor, 2)
    session.stop_recording().result()
    assert recorded_config(tmp_path / "live.mcap") == first
    source = open_source(str(tmp_path / "live.mcap"))
    assert any("changed 1 times; it plays with the first one" in notice for notice in source.info.notices)
    source.close()


def test_ticks_that_were_not_written_are_told(corridor: Corridor, open_session: Open, tmp_path: Path):
    session = open_session()
    recorder = Recorder(tmp_path / "live.mcap", corridor.stream, seed=0, failed=pytest.fail)
    for frame in ticks_of(session, corridor, 2):
        recorder.put(frame)
    recorder.close(dropped=3)
    with contextlib.closing(open_source(str(tmp_path / "live.mcap"))) as source:
        assert "3 ticks were not written" in " ".join(source.info.notices)


def test_closing_the_session_finishes_the_recording(corridor: Corridor, open_session: Open, tmp_path: Path):
    session = open_session(rate=50.0)
    session.start()
    session.record(tmp_path / "live.mcap").result()
    recorder = session.recorder
    deadline = time.monotonic() + 60.0
    while recorder is not None and recorder.ticks < 3:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    session.close()
    session.close()
    assert (tmp_path / "live.mcap").read_bytes().endswith(MCAP_MAGIC)


def test_only_one_file_is_recorded(corridor: Corridor, open_session: Open, tmp_path: Path):
    session = open_session()
    session.record(tmp_path / "a.mcap").result()
    with pytest.raises(UserError, match=r"a\.mcap is being recorded"):
        session.record(tmp_path / "b.mcap").result()


def test_the_ticks_that_are_kept_are_bounded(corridor: Corridor, open_session: Open):
    session = open_session(kept=0.5, rate=20.0)
    frames = ticks_of(session, corridor, 14)
    assert session.time_range[0] == frames[4].time
    session.seek(frames[0].time).result()
    assert session.frame is not None and session.frame.time == frames[4].time
    ticks_of(session, corridor, 2)  # the tick that is shown falls out of what is kept
    session.step(1).result()
    session.play()
    assert ticks_of(session, corridor, 1)[0].index == 16


def test_a_and_b_are_compared_on_the_stream(corridor: Corridor, open_session: Open):
    session = open_session()
    ticks_of(session, corridor, 2)
    session.pin().result()
    session.configure({"costs.q_position": 9.0})
    assert session.playing
    newest = ticks_of(session, corridor, 1)[0]
    session.catch_up().result()
    compared = session.comparison.frame
    assert compared is not None and compared.time == newest.time and not same(compared, newest)


def test_the_goal_of_the_stream_leaves_what_was_planned(corridor: Corridor, open_session: Open):
    session = open_session()
    first = ticks_of(session, corridor, 1)[0]
    session.set_goal((10.0, 1.0, 2.0)).result()
    assert session.frame is first
    assert np.array_equal(ticks_of(session, corridor, 1)[0].observation.goal.position, [10.0, 1.0, 2.0])


def test_a_stream_has_its_own_speed(open_session: Open):
    with pytest.raises(UserError, match="speed of its own"):
        open_session().set_speed(2.0)


def test_a_session_plans_by_itself(corridor: Corridor, open_session: Open):
    session, frames = open_session(rate=50.0), []
    session.subscribe_ticks(frames.append, name="test")
    session.start()
    deadline = time.monotonic() + 60.0
    while len(frames) < 5:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    assert [frame.index for frame in frames[:5]] == list(range(5))
