"""A recording in a session: what frames count, and what the user is told of damage."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from small_source import small_config

from aero_viz.recordings import RecordingSource, open_recording
from aero_viz.session import Session


@pytest.fixture
def path(bags, mcap_of):
    return mcap_of(bags.drive(sweeps=14))


@pytest.fixture
def source(path) -> RecordingSource:
    return RecordingSource(open_recording(path))


@pytest.fixture
def session(source: RecordingSource) -> Iterator[Session]:
    session = Session(source, config=small_config())
    yield session
    session.close()


def test_a_frames_index_is_its_row_in_the_recording_however_it_was_reached(session: Session) -> None:
    times = session.source.times
    assert times is not None
    assert [session.tick().index for _ in range(5)] == [0, 1, 2, 3, 4]
    for wanted in (20, 4, 4):
        session.seek(float(times[wanted])).result()
        assert session.frame is not None and session.frame.index == wanted and len(session.frame.trail) == 1
    session.step(-3).result()
    assert session.frame.index == 1
    session._engine.skip_to(float(times[9]))
    assert session.tick().index == 9
    np.testing.assert_allclose(session.frame.time, times[9])


def test_lost_ticks_are_counted_until_another_source_comes(session: Session, path) -> None:
    session.tick()
    session._engine.skip_to(float(session.source.times[6]))  # type: ignore[index]
    assert session.tick().dropped_ticks == 5
    session.seek(0.0).result()
    assert session.frame is not None and session.frame.dropped_ticks == 5
    session.set_source(RecordingSource(open_recording(path))).result()
    assert session.frame.dropped_ticks == 0


def test_sweeps_that_turn_out_to_be_damaged_are_told(session: Session, source: RecordingSource, path) -> None:
    told: list[str] = []
    sink = session.subscribe_notices(lambda notice: told.append(notice.text))
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
    assert told == [f"{source.info.name}: end of the recording. {frame.explanation}"]
