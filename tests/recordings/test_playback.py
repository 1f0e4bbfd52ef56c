"""A recording in a session: indices of frames, skipped ticks, and notices about damage."""

import os
from collections.abc import Iterator
from pathlib import Path

import bags
import numpy as np
import pytest
from ensemble_plans import plan_of
from mcap.writer import CompressionType
from small_source import small_config

from aero_viz.recordings import RecordingSource, open_recording
from aero_viz.session import Session
from aero_viz.session.config_history import ConfigHistory
from aero_viz.session.engine import Engine


@pytest.fixture
def path(mcap_of):
    return mcap_of(bags.drive(sweeps=14))


@pytest.fixture
def source(path) -> RecordingSource:
    return RecordingSource(open_recording(path))


@pytest.fixture
def session(source: RecordingSource) -> Iterator[Session]:
    session = Session(source, config=small_config())
    yield session
    session.close()


@pytest.fixture
def configs() -> ConfigHistory:
    return ConfigHistory(small_config())


@pytest.fixture
def engine(source: RecordingSource, configs: ConfigHistory) -> Iterator[Engine]:
    engine = Engine(source, configs=configs, device="cpu", seed=0, publish=lambda frame: None)
    yield engine
    engine.close()


def test_index_of_a_frame_is_its_row_in_the_recording(session: Session, source: RecordingSource):
    times = source.info.times
    assert times is not None
    assert [session.tick().index for _ in range(5)] == [0, 1, 2, 3, 4]
    for index in (20, 4, 4):
        session.seek(float(times[index])).result()
        assert session.frame is not None and session.frame.index == index
        assert len(session.frame.trail) == index + 1, "the planner has seen the ticks before it"
    session.step(-3).result()
    assert session.frame.index == 1


def test_the_plan_of_a_tick_does_not_depend_on_how_one_came_there(engine: Engine, configs: ConfigHistory):
    times = engine.source.info.times
    assert times is not None

    def seek(row: int) -> None:
        engine.seek(float(times[row]))

    def skip() -> None:
        engine.skip_to(float(times[20]))
        engine.tick()

    def move_the_goal() -> None:
        for goal in ([0.0, 30.0, 2.0], None):
            engine.alter(lambda source, goal=goal: source.set_goal(goal))  # type: ignore[arg-type]

    def change_a_weight() -> None:
        for q_track in (1.0, before.costs.q_track):
            configs.change({"costs.q_track": q_track})
            engine.tick()

    expected = plan_of([engine.tick() for _ in range(13)][-1])
    before = engine.planned_config
    for row, way in ((8, engine.tick), (3, skip), (5, move_the_goal), (6, change_a_weight), (25, engine.tick)):
        seek(row)
        way()
        seek(12)
        assert engine.frame is not None and engine.frame.index == 12
        np.testing.assert_array_equal(plan_of(engine.frame).controls, expected.controls, err_msg=str(way))
    seek(9)
    played = [engine.tick() for _ in range(3)][-1]
    assert played.index == 12
    np.testing.assert_array_equal(plan_of(played).controls, expected.controls)
    seek(20)
    engine.step_back(8)
    np.testing.assert_array_equal(plan_of(engine.frame).controls, expected.controls)


def test_index_and_time_after_skipped_ticks_are_those_of_the_row(engine: Engine):
    times = engine.source.info.times
    assert times is not None
    engine.tick()
    engine.skip_to(float(times[9]))
    frame = engine.tick()
    assert frame.index == 9 and frame.time == times[9]


def test_skipped_ticks_are_counted_until_the_source_changes(engine: Engine, path: Path):
    times = engine.source.info.times
    assert times is not None
    engine.tick()
    engine.skip_to(float(times[6]))
    assert engine.tick().dropped_ticks == 5
    engine.seek(0.0)
    assert engine.frame is not None and engine.frame.dropped_ticks == 5
    engine.set_source(RecordingSource(open_recording(path)))
    assert engine.frame.dropped_ticks == 0


def test_sweeps_damaged_during_playback_are_reported(session: Session, source: RecordingSource, path: Path):
    notices: list[str] = []
    sink = session.subscribe_notices(lambda notice: notices.append(notice.text))
    assert session.tick().explanation is None
    with path.open("r+b") as file:  # the disk fails while the recording plays
        file.seek(path.stat().st_size // 2)
        file.write(bytes(path.stat().st_size // 4))
    while (frame := session.tick()).outcome is None:
        pass
    assert sink.drain()
    count = len(source.recording.damaged_sweeps)
    assert 0 < count < 14 and frame.explanation is not None
    assert frame.explanation.startswith(f"{count} of 14 sweeps could not be read and played without points: ")
    assert notices == [f"{source.info.name}: end of the recording. {frame.explanation}"]


@pytest.mark.skipif(not hasattr(os, "posix_fadvise"), reason="the system takes no advice")
@pytest.mark.parametrize(("point_step", "ahead"), [(12, 4), (50_000, 3)])
def test_playback_reads_four_sweeps_ahead_but_at_most_32_mib(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, point_step: int, ahead: int
):
    advised: list[int] = []
    monkeypatch.setattr(os, "posix_fadvise", lambda file, start, length, advice: advised.append(length))
    items = [bags.cloud(0.1 * k, bags.xyz(np.ones((200, 3), "f4")), point_step=point_step) for k in range(7)]
    path = bags.write_mcap(tmp_path / "a.mcap", items, compression=CompressionType.NONE)
    with open_recording(path) as recording:
        for index in range(1, 7):
            advised.clear()
            assert len(recording.sweep(index).points) == 200
            assert len(advised) == min(ahead, 6 - index)
            assert all(200 * point_step < length < 200 * point_step + 1000 for length in advised)
            assert sum(advised) <= 32 << 20
